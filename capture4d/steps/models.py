"""What is learned from takes and drapes, and put on motions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from capture4d.app.cards.sources import with_card
from capture4d.app.compare.config import CompareConfig
from capture4d.captures.work_folder import AnyWork, Place, opened_work
from capture4d.runs.run_log import logged_stage
from capture4d.runs.stage import StageResult
from capture4d.steps.presets import chosen
from retarget.config import AnimateConfig, FitConfig
from retarget.mixture import config as mixture_config
from retarget.mixture.config import StyleFitConfig, StylesConfig
from wrinkles.normal_maps import config as wrinkle_config
from wrinkles.normal_maps.config import ApplyConfig, PairConfig, WrinkleConfig

if TYPE_CHECKING:
    from retarget.animation.stage import Wearer
    from retarget.mixture.style_of_work import StyleFound

__all__ = [
    "animate", "compare", "fit", "fit_style", "fit_styles", "wrinkles_apply", "wrinkles_maps", "wrinkles_train",
]  # fmt: skip


@logged_stage("fit")
def fit(
    works: Sequence[AnyWork],
    output: Place,
    config: FitConfig | None = None,
    *,
    device: str = "cpu",
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Learn the garment from registered takes of one template and person: its blendshapes, and what drives them.

    Args:
        output: folder to write, WORK/retarget by custom.
        device: where torch trains.
    """
    from retarget.fit_stage import run as stage

    opened = [opened_work(work) for work in works]
    done = stage(opened, Path(output), config or FitConfig(), device=device, workers=workers, overwrite=overwrite)
    return with_card(done)


@logged_stage("fit-styles")
def fit_styles(
    styles: Place,
    output: Place,
    config: StylesConfig | str | None = None,
    *,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Learn a garment in all its styles from a style set: a function of pose, shape and style.

    Args:
        styles: what `synth_drapes` wrote of a style set.
        config: settings, or the name of a preset.
        workers: torch's threads; the last bits of a network depend on their number.
    """
    from retarget.mixture.stage import run as stage

    settings = chosen(config, mixture_config.PRESETS)
    return with_card(stage(Path(styles), Path(output), settings, workers=workers, overwrite=overwrite))


def fit_style(
    model: Place,
    work: Place,
    output: Place,
    config: StyleFitConfig | None = None,
    *,
    overwrite: bool = False,
) -> StyleFound:
    """Find the style and the person of a garment that was registered or scanned; writes style.json.

    Args:
        model: what `fit_styles` wrote.
        work: of a take on the model's body, registered, or extracted and tracked.
        output: style.json; `.fit.style` of what is returned says the same.
        overwrite: also over a file that holds something else.
    Raises:
        InputError: nothing was seen there, or on another body.
    """
    from retarget.mixture.style_of_work import run as stage

    return stage(Path(model), Path(work), Path(output), config or StyleFitConfig(), overwrite=overwrite)


@logged_stage("animate")
def animate(
    model: Place,
    poses: Place,
    output: Place,
    config: AnimateConfig | None = None,
    *,
    wearer: Wearer | None = None,
    device: str = "cpu",
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Put a learned garment on a motion, and on another body: a sequence like a registered one.

    Args:
        model: what `fit` wrote.
        poses: motion file, .npz or .bvh.
        output: work folder; gets body/ and registration/.
        wearer: another person; None is the captured one.
    """
    from retarget.animation.stage import Wearer as Person
    from retarget.animation.stage import run as stage

    config, wearer = config or AnimateConfig(), wearer or Person()
    return stage(
        Path(model), Path(poses), Path(output), config,
        wearer=wearer, device=device, workers=workers, overwrite=overwrite,
    )  # fmt: skip


@logged_stage("wrinkles maps")
def wrinkles_maps(
    work: AnyWork,
    config: PairConfig | None = None,
    *,
    high_from: AnyWork | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Make normal maps of a registered take, low ones from the template, high ones from its scans.

    Args:
        high_from: work folder of the same frames, with finished maps, whose high ones are taken.
    """
    from wrinkles.normal_maps.maps_stage import run as stage

    lender = None if high_from is None else opened_work(high_from)
    return stage(opened_work(work), config or PairConfig(), high_from=lender, workers=workers, overwrite=overwrite)


@logged_stage("wrinkles train")
def wrinkles_train(
    works: Sequence[AnyWork],
    output: Place,
    config: WrinkleConfig | str | None = None,
    *,
    pairs: PairConfig | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Train the network that turns low maps into high ones; makes their maps if need be.

    Args:
        config: settings, or the name of a preset; the small one if None.
        workers: processes for the maps, threads for the training; equal numbers give equal weights.
    """
    from wrinkles.normal_maps.train_stage import run as stage

    opened, settings = [opened_work(work) for work in works], chosen(config, wrinkle_config.PRESETS)
    return with_card(stage(opened, Path(output), settings, pairs=pairs, workers=workers, overwrite=overwrite))


@logged_stage("wrinkles apply")
def wrinkles_apply(
    model: Place, work: AnyWork, config: ApplyConfig | None = None, *, workers: int = 1, overwrite: bool = False
) -> StageResult:
    """Make tangent-space normal maps with wrinkles for a registered or animated take: WORK/wrinkles/generated."""
    from wrinkles.normal_maps.apply_stage import run as stage

    return stage(Path(model), opened_work(work), config or ApplyConfig(), workers=workers, overwrite=overwrite)


@logged_stage("compare")
def compare(
    work: AnyWork,
    model: Place,
    config: CompareConfig | None = None,
    *,
    garment_model: Place | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Compare what was learned on the same held-out frames: WORK/compare; the result's path is its page.

    Args:
        model: what `wrinkles_train` wrote.
        garment_model: what `fit` wrote; WORK/retarget, if there is one, by default.
    """
    from capture4d.app.compare.page import run as stage

    learned, config = _maybe(garment_model), config or CompareConfig()
    return stage(opened_work(work), Path(model), config, garment_model=learned, workers=workers, overwrite=overwrite)


def _maybe(place: Place | None) -> Path | None:
    return None if place is None else Path(place)
