"""One page that compares what gives a garment its surface, on the same held-out frames: WORK/compare/index.html.

compare.json holds the table and names the pictures, which pictures/ keeps for the report.

registration        the template as registered, without a map
blendshapes         the registration, projected on a learned garment's principal directions
regression          the learned garment from the poses alone: linear, by the LSTM, by kernels, by both of these
network             the registration with maps made by a trained generator
offset images       vertices decoded from an image that a network predicts from the pose alone, learned here
fully connected     the same with a fully connected network on principal components

docs/methods/wrinkles.md defines the measures.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import jinja2
import numpy as np
import torch

from capture4d.app.compare.config import CompareConfig
from capture4d.app.compare.garment import Modelled, ModelledSurface, model_take
from capture4d.app.compare.offsets import megabytes, offset_surfaces
from capture4d.app.drawing.palette import CLOTH, HEIGHT, SKIN, WIDTH
from capture4d.app.drawing.panels import (
    Framing,
    Panel,
    colour_bar,
    data_uri,
    no_scan,
    readable_scan,
    write_panel,
)
from capture4d.app.drawing.render import Drawn, heat_colours, render
from capture4d.captures.capture import Capture
from capture4d.captures.truth import read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import (
    failed_frames,
    find_moving_body,
    load_registration,
    registered_digest,
    work_capture,
)
from capture4d.errors import InputError
from capture4d.evaluation import correspondence_errors, material_points
from capture4d.files.atomic import file_digest, read_json, write_bytes, write_json
from capture4d.geometry.uv_layout import millimetres_per_texel
from capture4d.runs.stage import open_stage, require_complete
from capture4d.types import RegisteredSequence
from retarget.animation.garment_model import GarmentModel, load_garment_model
from retarget.model_folder import learned_frames, regressor_files
from wrinkles.normal_maps.apply_stage import generated_normals
from wrinkles.normal_maps.config import PairConfig
from wrinkles.normal_maps.display import fill_holes
from wrinkles.normal_maps.inference import load_model
from wrinkles.normal_maps.metrics import angles, score
from wrinkles.normal_maps.pair_files import layout_digest, load_pairs, map_settings, pair_template
from wrinkles.normal_maps.pair_stage import ensure_pairs
from wrinkles.normal_maps.pairs import PairTake, split
from wrinkles.normal_maps.seams import seam_table
from wrinkles.normal_maps.spaces import to_tangent
from wrinkles.normal_maps.template import MapTemplate
from wrinkles.normal_maps.train_stage import learned_takes

__all__ = ["run"]

SCHEMA = 4
NETWORK = "network"
"""The registration with the network's map."""
ERROR_DEG = 30.0
"""Normal error at which the strip's colours saturate."""


@dataclass(frozen=True, slots=True, eq=False)
class _Method:
    """A surface for every held-out frame."""

    name: str
    vertices: np.ndarray
    """(T, V, 3)."""
    normals: np.ndarray
    """(T, N, 3) world, per texel."""
    ms_per_frame: float
    megabytes: float
    has_map: bool = False
    learned: bool = False
    """From some of these frames."""


@dataclass(frozen=True, slots=True)
class _Row:
    name: str
    vertex_mm: float | None
    normal_deg: float | None
    wrinkle_energy_kept: float | None
    flicker_deg: float | None
    ms_per_frame: float
    model_mb: float
    learned: bool
    """From some of these very frames: then it shows what the model holds, not what it foresees."""


def run(
    work: Path,
    model: Path,
    config: CompareConfig,
    *,
    garment_model: Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> Path:
    """Learn the baselines, measure, draw, unless that has been done; the path of the page.

    Args:
        model: folder of `capture4d wrinkles train`.
        garment_model: what `capture4d fit` wrote; WORK/retarget, if there is one, by default.
    Raises:
        InputError: the work folder lacks registration or scans, a model is of another template, or the network learned
            from all frames.
    """
    weights = model / "generator.safetensors" if model.is_dir() else model
    generator = load_model(weights)
    ensure_pairs(work, PairConfig(map=generator.maps), workers=workers)
    known = _garment_model(work, garment_model)
    upstream = {
        "registration": registered_digest(work),
        "pairs": require_complete(work / "wrinkles" / "pairs", "pairs", f"capture4d wrinkles maps {work}"),
        "model": file_digest([weights], root=weights.parent),
    }
    if known is not None:
        files = {path for name in known.regressors for path in regressor_files(known.folder, name)}
        upstream["garment model"] = known.digest
        upstream["regressors"] = file_digest(sorted(files), root=known.folder)
    capture, sequence = work_capture(work), load_registration(work / "registration")
    template = MapTemplate.create(sequence.garment, generator.maps).referred_to(pair_template(work).vertices)
    if layout_digest(template.mesh, generator.maps.size) != generator.layout_digest:
        raise InputError(f"{work}: expected the template that {weights} was trained on, found another")
    if layout_digest(pair_template(work), map_settings(work).size) != generator.layout_digest:
        raise InputError(f"{work / 'wrinkles' / 'pairs'}: expected maps laid out as {weights} has them "
                         f"({generator.maps}), found {map_settings(work)}")  # fmt: skip
    held_out, gap = _network_split(weights, work, upstream, config)
    stage = open_stage(
        work / "compare", name="compare", schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite
    )
    page_path = stage.path / "index.html"
    if page_path.is_file():  # the last file of a run
        stage.finish([page_path])
        return page_path
    torch.set_num_threads(workers)
    failed = failed_frames(work)
    learned, held = split(load_pairs(work), held_out=held_out, gap=gap)
    held = held.without(failed)
    if not len(held.frame_ids):
        raise InputError(f"{work}: expected held-out frames whose scans can be read, found none")
    rows = _rows(sequence, held.frame_ids, work)
    methods = [_registered(template, sequence, rows)]
    moving = find_moving_body(work)
    modelled: Modelled | None = None
    if known is not None and moving is not None:
        modelled = model_take(known, sequence, *moving, rows)
        seen = any(not set(rows).isdisjoint(part) for part in learned_frames(known.folder, upstream["registration"]))
        methods += [_without_map(each, template, learned=seen) for each in modelled.surfaces]
    seams, its_own = seam_table(template.mesh, template.raster), template.referred_to(generator.reference)

    def mapped(vertices: np.ndarray) -> np.ndarray:
        return generated_normals(generator, its_own, seams, vertices)

    size = megabytes(generator.generator)
    methods.append(_drawn_by(NETWORK, template, methods[0].vertices, mapped, size, has_map=True))
    if moving is not None and sequence.garment.skin_weights is not None:
        sound = [frame_id for frame_id in learned.frame_ids.tolist() if frame_id not in failed]
        surfaces = offset_surfaces(sequence, *moving, rows, _rows(sequence, sound, work), config)
        methods += [_without_map(each, template) for each in surfaces]
    truth = _true_vertices(capture, held.frame_ids)
    table = [_measure(method, template, held, truth, methods[0]) for method in methods]
    chosen = np.unique(np.linspace(0, len(held.frame_ids) - 1, min(config.pictures, len(rows))).astype(int))
    frames = [
        (
            int(held.frame_ids[at]),
            _pictures(capture, template, methods, held, int(at), mapped),
            _strip(template, methods, held, int(at)),
        )
        for at in chosen
    ]
    people = [] if modelled is None else _people(modelled, rows[len(rows) // 2])
    middle = int(held.frame_ids[len(rows) // 2])
    kept = [
        {"frame_id": frame_id, "panels": _keep(stage.path, f"{frame_id:06d}", panels)} for frame_id, panels, _ in frames
    ]
    others = {"frame_id": middle, "panels": _keep(stage.path, "people", people)}
    rows_kept = [asdict(row) for row in table]
    write_json(
        stage.path / "compare.json",
        {
            "frames": held.frame_ids,
            "against_truth": truth is not None,
            "methods": rows_kept,
            "pictures": kept,
            "people": others,
        },
    )
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True)
    page = environment.get_template("compare.html.jinja").render(
        name=capture.name, rows=table, frames=frames, count=len(held.frame_ids), against_truth=truth is not None,
        error_deg=ERROR_DEG, bar=colour_bar(ERROR_DEG), people=people, middle=middle,
    )  # fmt: skip
    write_bytes(page_path, page.encode())
    stage.finish([page_path])
    return page_path


def _people(modelled: Modelled, row: int) -> list[Panel]:
    """A frame on other people, all drawn at one scale."""
    dressed = modelled.on_people(row)
    spans = np.max([np.ptp(each.garment.vertices, axis=0) for each in dressed], axis=0).tolist()
    framing = Framing((1.3 * spans[0], 1.15 * spans[1], 1.3 * spans[2]))
    return [
        Panel(
            each.who,
            data_uri(
                render(
                    [Drawn(each.garment, CLOTH), Drawn(each.body, SKIN)],
                    framing.view(each.garment.vertices, "three_quarter"), width=WIDTH, height=HEIGHT,
                )
            ),
        )
        for each in dressed
    ]  # fmt: skip


def _keep(folder: Path, name: str, panels: Sequence[Panel]) -> list[dict[str, str]]:
    """Write pictures; their titles and files."""
    kept = []
    for number, panel in enumerate(panels):
        path = folder / "pictures" / f"{name}-{number}.webp"
        write_panel(path, panel)
        kept.append({"title": panel.title, "file": path.name})
    return kept


def _garment_model(work: Path, path: Path | None) -> GarmentModel | None:
    if path is None and not (work / "retarget" / "fit.json").is_file():
        return None
    return load_garment_model(work if path is None else path)


def _network_split(weights: Path, work: Path, upstream: Mapping[str, str], config: CompareConfig) -> tuple[float, int]:
    """The frames a network has not seen: its own split where it learned from this take.

    Args:
        upstream: digests of the take's pairs and registration.
    """
    record_path = weights.parent / "stage.json"
    record = read_json(record_path) if record_path.is_file() else {}
    settings, takes = record.get("config", {}), record.get("upstream", {})
    learned = upstream["pairs"] in takes.values() or upstream["registration"] in learned_takes(weights.parent)
    if settings.get("held_out", 0) > 0 and (learned or work.resolve().name in takes):
        return float(settings["held_out"]), int(settings["held_out_gap"])
    if learned:
        raise InputError(f"{weights}: expected a network that has not seen all frames of {work}, found one that "
                         "learned from it without held-out frames")  # fmt: skip
    return config.held_out, config.gap


def _rows(sequence: RegisteredSequence, frame_ids: Sequence[int] | np.ndarray, work: Path) -> list[int]:
    """Where frames lie in the registered sequence."""
    rows = {frame_id: row for row, frame_id in enumerate(sequence.frame_ids.tolist())}
    for frame_id in frame_ids:
        if int(frame_id) not in rows:
            raise InputError(f"{work}: frame {frame_id}: expected it among the registered frames, as it has a pair of "
                             "maps, found none")  # fmt: skip
    return [rows[int(frame_id)] for frame_id in frame_ids]


def _registered(template: MapTemplate, sequence: RegisteredSequence, rows: Sequence[int]) -> _Method:
    vertices = np.array(sequence.vertices[list(rows)])
    return _drawn_by("registration", template, vertices, template.low_normals, 0.0)


def _without_map(surface: ModelledSurface, template: MapTemplate, *, learned: bool = False) -> _Method:
    return _drawn_by(
        surface.name, template, surface.vertices, template.low_normals, surface.megabytes,
        extra_ms=surface.ms_per_frame, learned=learned,
    )  # fmt: skip


def _drawn_by(
    name: str,
    template: MapTemplate,
    vertices: np.ndarray,
    normals: Callable[[np.ndarray], np.ndarray],
    megabytes: float,
    *,
    extra_ms: float = 0.0,
    has_map: bool = False,
    learned: bool = False,
) -> _Method:
    maps, times = [], []
    for placed in vertices:
        begin = time.perf_counter()
        maps.append(normals(placed))
        times.append(1e3 * (time.perf_counter() - begin))
    return _Method(name, vertices, np.stack(maps), float(np.median(times)) + extra_ms, megabytes, has_map, learned)


def _true_vertices(capture: Capture, frame_ids: Sequence[int] | np.ndarray) -> np.ndarray | None:
    model = read_truth_model(capture)
    if model is None:
        return None
    return np.stack(
        [
            material_points(
                read_truth_vertices(capture, int(frame_id)), model.fine.faces, model.template_faces,
                model.template_barycentric,
            )
            for frame_id in frame_ids
        ]
    )  # fmt: skip


def _measure(
    method: _Method, template: MapTemplate, held: PairTake, truth: np.ndarray | None, registered: _Method
) -> _Row:
    """Against the scans' maps; vertices against the truth, or, where there is none, against the registration."""
    raster = template.raster
    images = [
        raster.image((normals @ template.rotation(vertices)).astype(np.float32))
        for normals, vertices in zip(method.normals, registered.vertices, strict=True)
    ]
    maps = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
    consecutive = torch.zeros(len(maps), dtype=torch.bool)
    consecutive[torch.from_numpy(held.consecutive())] = True
    scores = score(
        maps, held.high.float(), held.valid & torch.from_numpy(raster.image(raster.inside)),
        mm_per_texel=millimetres_per_texel(template.mesh, raster.size), consecutive=consecutive,
    )  # fmt: skip
    reference = truth if truth is not None else None if method is registered else registered.vertices
    errors = [] if reference is None else [
        correspondence_errors(a, b).mean() for a, b in zip(method.vertices, reference, strict=True)
    ]  # fmt: skip
    return _Row(
        method.name, _number(1e3 * float(np.mean(errors))) if errors else None, _number(scores.normal_error_deg),
        _number(scores.wrinkle_energy_kept), _number(scores.flicker_deg), method.ms_per_frame, method.megabytes,
        method.learned,
    )  # fmt: skip


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _pictures(
    capture: Capture,
    template: MapTemplate,
    methods: Sequence[_Method],
    held: PairTake,
    at: int,
    mapped: Callable[[np.ndarray], np.ndarray],
) -> list[Panel]:
    """The scan, the truth if there is one, every surface without and with the network's map, and the registration with
    its low map and with the scan's.

    Args:
        mapped: from vertices to the normals that the network gives them.
    """
    frame_id = int(held.frame_ids[at])
    registered = methods[0].vertices
    span = np.ptp(registered.reshape(len(registered), -1, 3), axis=1).max(axis=0)
    framing = Framing((float(span[0]), float(span[1]), float(span[2])))
    view = framing.view(registered[at], "three_quarter")
    scan = readable_scan(capture, frame_id)

    def drawn(vertices: np.ndarray, normal_map: np.ndarray | None = None) -> str:
        mesh = template.mesh.with_vertices(vertices)
        return data_uri(render([Drawn(mesh, normal_map=normal_map)], view, width=WIDTH, height=HEIGHT))

    frames = template.frames(registered[at])
    panels = [no_scan()]
    if scan is not None:
        shown = render([Drawn(scan.mesh, scan.colours)], view, width=WIDTH, height=HEIGHT)
        panels = [Panel("scan", data_uri(shown))]
    model = read_truth_model(capture)
    if model is not None:
        fine = model.fine.with_vertices(read_truth_vertices(capture, frame_id))
        panels.append(Panel("truth", data_uri(render([Drawn(fine)], view, width=WIDTH, height=HEIGHT))))
    for method in methods:
        vertices = method.vertices[at]
        own = template.frames(vertices)
        if method.has_map:
            panels.append(Panel(method.name, drawn(vertices, _tangent_image(template, method.normals[at], own))))
            continue
        panels.append(Panel(method.name, drawn(vertices)))
        if method is not methods[0]:  # whose picture with the network's map is the network's
            image = _tangent_image(template, mapped(vertices), own)
            panels.append(Panel(f"{method.name}, {NETWORK}'s map", drawn(vertices, image)))
    panels.append(Panel("low map", drawn(registered[at], _tangent_image(template, methods[0].normals[at], frames))))
    valid = template.raster.read(held.valid[at, 0].numpy())
    world = template.raster.read(held.high[at].float().permute(1, 2, 0).numpy()) @ template.rotation(registered[at]).T
    high = fill_holes(_tangent_image(template, world, frames), template.raster.image(valid))
    high[..., 2] = np.where(np.abs(high).sum(axis=-1) > 0, high[..., 2], 1)
    return [*panels, Panel("map of the scan", drawn(registered[at], high))]


def _tangent_image(template: MapTemplate, normals: np.ndarray, frames: np.ndarray) -> np.ndarray:
    image = template.raster.image(to_tangent(normals, frames).astype(np.float32))
    image[~template.raster.image(np.ones(len(normals), bool))] = (0, 0, 1)
    return image


def _strip(template: MapTemplate, methods: Sequence[_Method], held: PairTake, at: int) -> list[Panel]:
    """The angle of every method's normals to the scan's, in the map."""
    rotation, valid = template.rotation(methods[0].vertices[at]), held.valid[at].numpy()[0]
    panels = []
    for method in methods:
        image = template.raster.image((method.normals[at] @ rotation).astype(np.float32))
        angle = angles(torch.from_numpy(image).permute(2, 0, 1)[None], held.high[at].float()[None])[0, 0].numpy()
        colours = heat_colours(np.where(valid, angle, np.nan).ravel(), high=ERROR_DEG).reshape(*angle.shape, 3)
        panels.append(Panel(method.name, data_uri(colours)))
    return panels
