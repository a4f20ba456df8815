"""What is printed on a template: learned from the first frames of a take, or read from a picture over its UVs.

Learned: frames of the first second in which the body stands nearly as in the first are registered without colour, the
scans' colours there are averaged, the frames are registered to that average, and averaged again, twice. What each of
them was off by alone is taken out by that; what all were off by stays, for nothing but the print itself knows better.
Where the body moves away, cloth slides, and how far nothing tells.

Cloth is printed if its colours differ by more than folds under a lamp can make them: what the logarithms of the
colours differ by from their mean over a hand's breadth is fitted by the normals, which tell the light, and the rest is
looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.ndimage import gaussian_filter, map_coordinates

from capture4d.body.sewing_pattern import picture_span
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_npz
from capture4d.geometry.point_grid import PointGrid
from capture4d.types import GarmentScan
from capture4d.value_checks import require_array, require_finite
from registration.alignment import fit_similarity
from registration.cloth_colours import ClothColours, ColourSamples, log_colours, sample_faces, see_colours
from registration.colour_term import without_light
from registration.config import RegistrationConfig, Schedule
from registration.predictions import Mover
from registration.register import FrameScan, prepare_frame, register_frame
from registration.sequence import register_run
from registration.template import TemplateAnalysis

__all__ = [
    "learn_print",
    "learning_positions",
    "load_print",
    "print_contrast",
    "print_of_picture",
    "save_print",
    "still_positions",
]

LEVELS = ((0.014, 0.022), (0.007, 0.0065))
"""Distance between samples, and reach of the blur, metres: wide, then narrow. A print with features of 10 mm is found
from 8 mm away, and to half a millimetre (`python -m benchmarks registration --data printed`)."""
LESS_WIDE = (0.015, 0.01)
"""Reaches of the wide blur for prints that are too fine to be seen under it, such as stripes."""
SEEN_SHARE = 0.24
"""Of the narrowly blurred colours' variance, that is left under a wide blur that sees the print."""
LEAST_SPACINGS = 2.5
"""No blur reaches less far than so many sample spacings of the scan."""
BLUR_OF_REACH = 0.354
"""Standard deviation of the bell (1 - d^2 / reach^2)^2, as a share of its reach."""
FROM_BORDER_M = 0.025
"""Nearer to a border the cloth may be painted, and the border's own term says where it is."""
CONTRAST = 0.35
"""Of the logarithms of sRGB. One place in a hundred of a printed cloth differs by more."""
LEARNED_FPS, LEARNED_FRAMES, AVERAGED, ROUNDS = 20.0, 19, 4, 2
"""Frames that are registered before the print is known, so many a second; how many of them, evenly spread, it is
learned from; and how often they are registered to it."""
STILL_M, FEWEST_FRAMES = 0.02, 3
"""Mean way of the skinned template from the first frame, but for turns and shifts as a whole, up to which a frame is
learned from; and how many are whatever the pose. Chosen on person 1 of `benchmarks.printed_takes`."""
HELD = Schedule(2, (0.012, 0.012), smooth=(0.2, 0.2), stretch=(2.0, 2.0), boundary=(0.1, 0.1))
"""Dense steps of these."""


def learning_positions(frames: int, fps: float) -> range:
    """The first frames of a take, by position, that a print is learned from."""
    stride = max(1, round(fps / LEARNED_FPS))
    return range(0, min(frames, (LEARNED_FRAMES - 1) * stride + 1), stride)


def learn_print(
    analysis: TemplateAnalysis,
    mover: Mover | None,
    positions: Sequence[int],
    frame_ids: Sequence[int],
    *,
    load: Callable[[int], GarmentScan],
    config: RegistrationConfig,
) -> tuple[tuple[ClothColours, ...], float]:
    """The template's colours, none where the cloth is plain; and its contrast, NaN where no scan has colours.

    Args:
        positions: of the frames to learn from, ascending, in a take with these `frame_ids`.
        load: the garment scan of a frame.
    """
    found: list[tuple[FrameScan, np.ndarray]] = []
    positions = positions if mover is None else still_positions(mover.skinned, positions)
    adrift = replace(config, sequence=replace(config.sequence, relax=0.0))
    samples, contrast, reaches = _samples(analysis), float("nan"), tuple(reach for _, reach in LEVELS)
    for result in register_run(
        analysis, mover, positions, frame_ids, load=load, done=lambda position, before: None, config=adrift
    ):
        if result.quality.verdict == "failed":
            continue
        scan = _coloured_frame(analysis, load(result.frame_id), config)
        if scan.colours is None:
            break
        found.append((scan, result.vertices.astype(np.float64)))
        if len(found) == 1:
            reaches = _reaches(lambda tried: _average(analysis, samples, found, None, tried))
            first = _average(analysis, samples, found, None, reaches)
            contrast = print_contrast(analysis, first[-1], found[0][1])
            if contrast < CONTRAST:
                break
    if not contrast >= CONTRAST:
        return (), contrast
    chosen = np.unique(np.linspace(0, len(found) - 1, min(AVERAGED, len(found))).round().astype(int))
    frames = [found[row] for row in chosen]
    cloth = _average(analysis, samples, frames, None, reaches)
    still = replace(config.coarse, warm=replace(config.coarse.warm, steps=0))
    held = replace(config, coarse=still, dense=replace(config.dense, warm=HELD))
    for _ in range(ROUNDS):
        printed = replace(analysis, cloth=cloth)
        frames = [
            (scan, register_frame(printed, scan, vertices, config=held, schedule="warm").vertices)
            for scan, vertices in frames
        ]
        cloth = _average(analysis, samples, frames, cloth, reaches)
    return _where_printed(analysis, cloth), contrast


def still_positions(skinned: Callable[[int], Float64[np.ndarray, "verts 3"]], positions: Sequence[int]) -> list[int]:
    """Those of ascending positions at which the body stands nearly as at the first.

    Args:
        skinned: the template in the pose at a position.
    """
    first, found = skinned(positions[0]), []
    for count, position in enumerate(positions):
        there = skinned(position)
        moved = np.linalg.norm(fit_similarity(there, first, with_scale=False).apply(there) - first, axis=1)
        if count < FEWEST_FRAMES or moved.mean() < STILL_M:
            found.append(position)
    return found


def _coloured_frame(analysis: TemplateAnalysis, scan: GarmentScan, config: RegistrationConfig) -> FrameScan:
    """A frame with its colours, though those of the template are not known."""
    frame = prepare_frame(analysis, scan, config)
    return frame if scan.colours is None else replace(frame, colours=log_colours(frame.surface.of_points(scan.colours)))


def print_contrast(analysis: TemplateAnalysis, cloth: ClothColours, vertices: Float64[np.ndarray, "verts 3"]) -> float:
    """What the colours of one place in a hundred differ from those around it by, but for the light on folds.

    Args:
        cloth: colours learned from one frame.
        vertices: of the template in that frame.
    """
    known = cloth.known.astype(np.float64)
    if not known.any():
        return 0.0
    about = without_light(analysis, cloth.samples, cloth.values, known)[cloth.known]
    tilt = without_light(analysis, cloth.samples, cloth.samples.normals(vertices), known)[cloth.known]
    about = about - tilt @ np.linalg.lstsq(tilt, about, rcond=None)[0]
    return float(np.percentile(np.abs(about).max(axis=1), 99))


def print_of_picture(
    analysis: TemplateAnalysis, picture: UInt8[np.ndarray, "rows columns 3"]
) -> tuple[ClothColours, ...]:
    """The template's colours as a picture over its UVs has them: over 0 to 1, as textures lie, or over the bounding box
    of UVs that are a pattern in metres, or reach beyond.

    Raises:
        InputError: the template has no UVs.
    """
    low, high = picture_span(analysis.garment)
    uv = analysis.garment.template.uv
    assert uv is not None
    corners = uv.astype(np.float64)
    lengths = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)
    edges = analysis.rest[analysis.faces]
    metres = float((np.linalg.norm(edges - edges[:, [1, 2, 0]], axis=2) / np.maximum(lengths, 1e-12)).mean())
    pixels = np.array(picture.shape[:2])[::-1] / (metres * (high - low))  # a metre, along u and v
    levels, logarithms = _samples(analysis), log_colours(picture)

    def coloured(reaches: Sequence[float]) -> tuple[ClothColours, ...]:
        found = []
        for samples, reach in zip(levels, reaches, strict=True):
            places = (samples.of_corners(corners) - low) / (high - low)
            across, down = BLUR_OF_REACH * reach * pixels
            blurred = gaussian_filter(logarithms, (down, across, 0))
            values, step = _between_pixels(blurred, places), 0.25 * reach / (metres * (high - low))
            steep = [
                (_between_pixels(blurred, places + side) - _between_pixels(blurred, places - side)) / (0.5 * reach)
                for side in np.diag(step)
            ]
            gradients = np.stack([*steep, np.zeros_like(values)], axis=-1)
            found.append(_cloth(analysis, samples, reach, values, samples.inner, gradients))
        return tuple(found)

    return _where_printed(analysis, coloured(_reaches(coloured)))


def save_print(path: Path, cloth: Sequence[ClothColours], contrast: float) -> None:
    """Write the colours of a template; of a plain one none."""
    arrays = {}
    for level, each in enumerate(cloth):
        arrays[f"values_{level}"], arrays[f"known_{level}"] = each.values.astype(np.float32), each.known
        arrays[f"scales_{level}"] = np.array([each.reach, each.steepness, each.spread])
    write_npz(path, contrast=np.float64(contrast), levels=np.int32(len(cloth)), **arrays)


def load_print(path: Path, analysis: TemplateAnalysis) -> tuple[ClothColours, ...]:
    """The colours of a template that were written for it.

    Raises:
        InputError: the file is damaged, or was written for another template.
    """
    found = []
    with ArrayFile(path, kind="print") as arrays:
        if not int(arrays["levels"]):
            return ()
        for level, samples in enumerate(_samples(analysis)):
            reach, steepness, spread = arrays[f"scales_{level}"].tolist()
            values, known = arrays[f"values_{level}"], arrays[f"known_{level}"]
            require_array("print", "values", values, (len(samples), 3), np.float32)
            require_array("print", "known", known, (len(samples),), np.bool_)
            require_finite("print", "values", values)
            found.append(ClothColours(samples, reach, values.astype(np.float64), known, steepness, spread))
    return tuple(found)


def _samples(analysis: TemplateAnalysis) -> list[ColourSamples]:
    """Of each level, the same for equal templates."""
    aside = np.zeros(len(analysis.faces), bool)
    if len(analysis.border.vertices):
        border = PointGrid.build(analysis.rest[analysis.border.vertices], FROM_BORDER_M)
        near = np.isfinite(border.query(analysis.rest, FROM_BORDER_M)[0])
        aside = np.asarray(near[analysis.faces].any(axis=1))
    edge = float(analysis.rest_lengths.mean())
    return [sample_faces(analysis.faces, max(1, round(edge / spacing)), aside) for spacing, _ in LEVELS]


def _where_printed(analysis: TemplateAnalysis, cloth: Sequence[ClothColours]) -> tuple[ClothColours, ...]:
    """The same, known only where there is a print within a hand's breadth: on plain cloth beside a logo colours tell of
    nothing but folds under a lamp."""
    sharp = cloth[-1]
    known = sharp.known.astype(np.float64)
    square = without_light(analysis, sharp.samples, sharp.values, known) ** 2
    around = (square - without_light(analysis, sharp.samples, square, known)).sum(axis=1)
    printed = np.zeros(len(analysis.rest), bool)
    printed[sharp.samples.vertices[sharp.known & (around > (CONTRAST / 2) ** 2)]] = True
    return tuple(replace(each, known=each.known & printed[each.samples.vertices].all(axis=1)) for each in cloth)


def _reaches(coloured: Callable[[Sequence[float]], Sequence[ClothColours]]) -> tuple[float, float]:
    """Of the wide and the narrow blur: the widest that still sees the print, else the narrow one twice.

    Args:
        coloured: the cloth's colours under given blurs.
    """
    narrow = LEVELS[-1][1]
    for wide in (LEVELS[0][1], *LESS_WIDE):
        found = coloured((wide, narrow))
        if found[0].spread >= SEEN_SHARE * found[-1].spread:
            return wide, narrow
    return narrow, narrow


def _average(
    analysis: TemplateAnalysis,
    levels: Sequence[ColourSamples],
    frames: Sequence[tuple[FrameScan, np.ndarray]],
    before: Sequence[ClothColours] | None,
    reaches: Sequence[float],
) -> tuple[ClothColours, ...]:
    """Mean colours of the frames, each in the light of the colours before, or else of the first."""
    found = []
    spacing = float(np.mean([scan.surface.spacing for scan, _ in frames]))
    for level, samples in enumerate(levels):
        reach = max(reaches[level], LEAST_SPACINGS * spacing)
        total, count = np.zeros((len(samples), 3)), np.zeros(len(samples))
        light, steep = None if before is None else (before[level].values, before[level].known), np.zeros(())
        for scan, vertices in frames:
            assert scan.colours is not None
            seen = see_colours(scan.surface, scan.colours, samples, vertices, reach)
            values, known = light = light or (seen.values, seen.known)
            both = (known & seen.known).astype(np.float64)
            total += seen.known[:, None] * (values + without_light(analysis, samples, seen.values - values, both))
            count += seen.known
            steep = np.where(seen.known[:, None, None], seen.gradients, steep)  # of any frame: their size alone counts
        found.append(_cloth(analysis, samples, reach, total / np.maximum(count, 1)[:, None], count > 0, steep))
    return tuple(found)


def _cloth(
    analysis: TemplateAnalysis,
    samples: ColourSamples,
    reach: float,
    values: np.ndarray,
    known: np.ndarray,
    gradients: np.ndarray,
) -> ClothColours:
    """Colours with their scales: means weighted by themselves, so that they are those of the print, not of what plain
    cloth is between."""
    square = (without_light(analysis, samples, values, known.astype(np.float64)) ** 2).sum(axis=1)[known]
    steep = (gradients**2).sum(axis=(1, 2))[known] / 2
    steepness = np.sqrt((steep**2).sum() / max(float(steep.sum()), 1e-12))
    spread = (square**2).sum() / max(float(square.sum()), 1e-12)
    return ClothColours(samples, reach, values, known, max(float(steepness), 1e-9), max(float(spread), 1e-9))


def _between_pixels(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Of an image at places, (u, v) from 0 to 1; v = 1 is its first row."""
    rows, columns = image.shape[:2]
    at = [(1 - places[:, 1]) * rows - 0.5, places[:, 0] * columns - 0.5]
    channels = [map_coordinates(image[..., c], at, order=1, mode="nearest") for c in range(3)]
    return np.stack(channels, axis=-1)
