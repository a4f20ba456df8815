"""Garments with styles: pairs and poses that were learned from or not, beside what learns little or nothing.

Limits this benchmark is built against, on `tshirt-styles`: the default's vertex error over that of the single network
on the same drapes at most 0.95 (prototypes in unseen poses), 0.88 (unseen pairs in seen poses) and 0.90 (both unseen),
normals no worse, `fine_share` at least 0.8; the paper's mixture, its bandwidth chosen by leaving prototypes out, at
most 1.0. Without `--quick` it has not been run: its drapes take about two hours on two cores.

The paper prints 10.2, 11.4 and 11.4 mm for its mixture and 10.6, 11.7 and 11.6 for its single network (TailorNet, Table
3; 20 prototypes in 2,600 poses).
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console

from benchmarks.cached_takes import one_maker
from benchmarks.metric import Metric
from benchmarks.style_use import fit_metrics, frame_metrics, prototype_metrics, solver_metrics
from capture4d.cache import user_cache_folder
from capture4d.captures.drapes.style_sets import read_style_set
from data_synth.drapes.stage import SCHEMA as DRAPES_SCHEMA
from data_synth.styles.config import STYLE_SETS, StyleSetConfig
from data_synth.styles.stage import SCHEMA
from data_synth.styles.stage import run as make_styles
from retarget.mixture.baselines import BASELINES, blended_prototypes, nearest_drape, skinned
from retarget.mixture.config import PRESETS, StylesConfig
from retarget.mixture.evaluation import PartErrors, Unposed, measure, unposed_by
from retarget.mixture.learning import learn_styles
from retarget.mixture.lesson import Part, StyleLesson, style_lesson
from retarget.mixture.styled_garment import StyledGarment

KEYS: Mapping[Part, str] = {"train-test": "train_test", "test-train": "test_train", "test-test": "test_test"}
"""Parts that tell something: the first is what was learned from."""


def run(
    *,
    quick: bool = False,
    seeds: tuple[int, ...] = (),
    styles: Path | None = None,
    paper: bool = False,
    fresh: bool = False,
    workers: int = 2,
) -> list[Metric]:
    """Learn a style set with the default, the paper's mixture and baselines; find styles again, and time a frame.

    Args:
        quick: `tiny-styles`, half a minute of drapes, in place of `tshirt-styles`.
        seeds: of the drapes; errors are means over all of them. None: two sets with `--quick`, else one.
        styles: a style set that is there, as `synth-drapes --preset` makes one, in place of those.
        paper: learn the recipe of `--preset paper` as well, with its large networks.
        fresh: make the drapes anew, though they are in the cache folder: as after a change of the solver.
    """
    base = STYLE_SETS["tiny-styles" if quick else "tshirt-styles"]
    errors: dict[str, list[Mapping[Part, PartErrors]]] = {}
    notes = []
    begun = time.process_time()
    use: dict[str, list[Metric]] = {}
    for seed in seeds or ((0, 1) if quick and styles is None else (0,)):
        folder = styles or _drapes(replace(base, seed=seed), fresh=fresh, workers=workers)
        lesson = style_lesson(read_style_set(folder))
        predictions, note, garment = _predictions(lesson, paper=paper)
        notes.append(note)
        for metric in (
            *prototype_metrics(lesson),
            *frame_metrics(garment, lesson),
            *(solver_metrics(replace(base, seed=seed), lesson) if styles is None else ()),
            *fit_metrics(garment, lesson, frames=1 if quick else 3),
        ):
            use.setdefault(metric.key, []).append(metric)
        for name, predict in predictions.items():
            errors.setdefault(name, []).append(measure(lesson, predict))
    return [
        *_metrics(errors),
        *(replace(found[0], value=_mean([each.value for each in found])) for found in use.values()),
        Metric("effective_prototypes", _mean([note["effective_prototypes"] for note in notes]), "", "higher"),
        Metric("a_pose_left_out_mm", _mean([note["a_pose"]["left_out_rms_mm"] for note in notes]), "mm"),
        Metric("cpu_s", time.process_time() - begun, "s"),
    ]


def _drapes(config: StyleSetConfig, *, fresh: bool, workers: int) -> Path:
    """A style set in the cache folder, made if this machine has not done so before."""
    key = hashlib.sha256(json.dumps([SCHEMA, DRAPES_SCHEMA, asdict(config)], sort_keys=True).encode()).hexdigest()[:12]
    folder = user_cache_folder() / "takes" / f"{config.garment}-styles-{key}"
    with one_maker(folder):
        make_styles(folder, config, workers=workers, overwrite=fresh)
    return folder


def _predictions(lesson: StyleLesson, *, paper: bool) -> tuple[dict[str, Unposed], dict, StyledGarment]:
    """Everything that is compared, how default and mixture were learned, and the default."""
    configs: dict[str, StylesConfig] = {
        "default": StylesConfig(),
        **BASELINES,
        "mixture": StylesConfig(method="mixture", over="body"),
        "mixture_over_drape": StylesConfig(method="mixture"),
        **({"paper": PRESETS["paper"]} if paper else {}),
    }
    found, note, learned = {}, {}, {}
    with tempfile.TemporaryDirectory() as folder:
        for name, config in configs.items():
            garment, said, _ = learn_styles(lesson, config, Path(folder) / name)
            found[name], learned[name] = unposed_by(garment), garment
            note = {**said, **note}
            if name == "default":
                found |= {
                    "skinned": skinned(garment),
                    "nearest": nearest_drape(lesson, garment),
                    "blended": blended_prototypes(lesson, garment),
                }
    return found, note, learned["default"]


def _metrics(errors: Mapping[str, list[Mapping[Part, PartErrors]]]) -> list[Metric]:
    """Ratios to what they have to beat first, then what every prediction is off by, as a table on the screen too."""
    mean = {
        (name, key): {
            field: _mean([getattr(each[part], field) for each in found])
            for field in ("vertex_mm", "unposed_mm", "normal_deg", "fine_share")
        }
        for name, found in errors.items()
        for part, key in KEYS.items()
    }
    for (name, key), each in mean.items():
        told = ", ".join(f"{field} {value:.3g}" for field, value in each.items())
        Console(stderr=True).print(f"{name}, {key}: {told}", soft_wrap=True)
    metrics = []
    for key in KEYS.values():
        default, single = mean["default", key], mean["mlp", key]
        metrics += [
            Metric(f"default_to_mlp_{key}", default["vertex_mm"] / single["vertex_mm"]),
            Metric(f"normals_to_mlp_{key}", default["normal_deg"] / single["normal_deg"]),
            Metric(f"mixture_to_mlp_{key}", mean["mixture", key]["vertex_mm"] / single["vertex_mm"]),
            Metric(f"{key}_to_skinned", default["vertex_mm"] / mean["skinned", key]["vertex_mm"]),
            Metric(f"{key}_fine_share", default["fine_share"], "", "higher"),
        ]
    for (name, key), each in mean.items():
        metrics.append(Metric(f"{name}_{key}_mm", each["vertex_mm"], "mm"))
    return metrics


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
