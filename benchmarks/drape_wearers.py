"""Every kind of garment in two styles on three people: what is kept, stretched, inside the body, and how far a
waistband slips.

Poses are random, as in a set of drapes; a waistband is measured in two more, standing and in a squat. Limits that this
was built against are those of `benchmarks.drapes`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.body.skinning import PosedBody, skin, with_pose
from data_synth.drapes.config import DrapesConfig, GarmentName, PoseConfig
from data_synth.drapes.draping import Draper
from data_synth.drapes.garments import GARMENTS
from data_synth.drapes.poses import draw_pose, sample_pose
from data_synth.drapes.quality import DrapeQuality, measure_drape

__all__ = ["OTHER_STYLES", "PEOPLE", "WearerDrapes", "garment_figures", "measure_wearer", "wearers"]

PEOPLE: dict[str, tuple[float, ...]] = {"mean": (), "heavy": (1.5, 1.5), "thin": (-1.5, -1.0)}
"""Shapes, in standard deviations of height and girth."""
OTHER_STYLES: dict[GarmentName, tuple[str, ...]] = {
    "tshirt": ("ease=0.35", "sleeve_length=0.85", "hem_drop_m=0.16"),
    "shirt": ("ease=0.3", "cuff_width=0.75", "sleeve_length=0.8"),
    "trousers": ("ease=0.2", "hem_width=1.0", "length=0.8"),
    "skirt": ("length_m=0.6", "flare=1.9"),
    "necktie": ("length_m=0.45", "width_m=0.07"),
}
"""Beside the draft's own."""
STANDING = PoseConfig(
    distribution="uniform", spine_bend=(0, 0), spine_turn=(0, 0), spine_side=(0, 0), neck_bend=(0, 0),
    neck_turn=(0, 0), neck_side=(0, 0), hip_flexion=(0, 0), hip_abduction=(0, 0), hip_rotation=(0, 0), knee=(0, 0),
)  # fmt: skip
SQUAT = replace(STANDING, hip_flexion=(80, 80), hip_abduction=(15, 15), knee=(100, 100))
FAR_FLEXED_DEG = 60.0
"""Beyond which a hip makes a pose a squat, whose edges may be 1.2 of their length; so may they with a raised arm."""


@dataclass(frozen=True, slots=True, eq=False)
class WearerDrapes:
    """One garment of one style on one person in N random poses."""

    garment: GarmentName
    wearer: str
    own_style: bool
    quality: Sequence[DrapeQuality]
    far: np.ndarray
    """(N,) bool: squats and raised arms."""
    slip_mm: tuple[float, float] | None
    """How far the waistband has slipped, standing and in a squat; None for what has none."""
    put_on_cpu_s: float
    drape_cpu_s: float

    @property
    def kept_percent(self) -> float:
        return 100 * float(np.mean([not each.reasons for each in self.quality]))


def wearers(
    names: Sequence[GarmentName], *, vertices: Mapping[GarmentName, int], samples: int, seed: int
) -> list[tuple[str, DrapesConfig]]:
    """Who wears what: the name of a person and the settings of the drapes. Patterns are drafted for who wears them:
    what is cut for the mean person does not fit a heavy one."""
    return [
        (
            person,
            DrapesConfig(
                garment=name,
                style=style,
                beta=beta,
                drafted_for="wearer",
                vertices=vertices[name],
                samples=samples,
                seed=seed,
            ),
        )
        for name in names
        for style in ((), OTHER_STYLES[name])
        for person, beta in PEOPLE.items()
    ]


def measure_wearer(job: tuple[str, DrapesConfig]) -> WearerDrapes:
    """Drape and measure; poses are those of a set of drapes with these settings."""
    wearer, config = job
    kind, started = GARMENTS[config.garment], time.process_time()
    draper = Draper(config, load_anny())
    ready = time.process_time() - started
    quality, far, costs = [], [], []
    for number in range(config.samples):
        rng = np.random.default_rng([config.seed, 0, number])
        pose, _ = draw_pose(draper.person, kind.limbs, config.poses, rng)
        started = time.process_time()
        drape = draper.drape(pose)
        costs.append(time.process_time() - started)
        quality.append(measure_drape(draper, pose, drape)[0])
        far.append(_is_far(with_pose(draper.person, pose, np.zeros(3)), kind.limbs))
    slip = None
    if "waist" in draper.mesh.loops:
        slip = _waist_slip_mm(draper, STANDING), _waist_slip_mm(draper, SQUAT)
    return WearerDrapes(
        config.garment, wearer, not config.style, quality, np.array(far), slip, ready, float(np.mean(costs)),
    )  # fmt: skip


def garment_figures(worn: Sequence[WearerDrapes]) -> dict[str, tuple[float, str]]:
    """Figures of a garment over all who wear it, with units: kept, of all and of the worst wearer; stretch that 95 %
    of the drapes are below, in calm poses and in squats and with raised arms (NaN where there is none); vertices inside
    the body, of all drapes and of the kept; the farthest slip of a waistband."""
    quality = [each for one in worn for each in one.quality]
    far = np.concatenate([one.far for one in worn])
    stretch = np.array([each.stretch_p99 for each in quality])
    kept = [each.inside_percent for each in quality if not each.reasons]
    figures = {
        "wearers_kept_percent": (float(np.mean([one.kept_percent for one in worn])), "%"),
        "worst_wearer_kept_percent": (min(one.kept_percent for one in worn), "%"),
        "wearers_calm_stretch_p99": (_percentile(stretch[~far], 95), ""),
        "wearers_far_stretch_p99": (_percentile(stretch[far], 95), ""),
        "wearers_inside_percent": (float(np.mean([each.inside_percent for each in quality])), "%"),
        "wearers_kept_inside_percent": (float(np.mean(kept)) if kept else float("nan"), "%"),
    }
    slips = np.array([one.slip_mm for one in worn if one.slip_mm is not None])
    if len(slips):
        figures["standing_slip_mm"], figures["squat_slip_mm"] = ((float(each), "mm") for each in slips.max(axis=0))
    return figures


def _percentile(values: np.ndarray, percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else float("nan")


def _is_far(body: PosedBody, limbs: tuple[str, ...]) -> bool:
    """Whether an arm is above the horizontal, or a thigh beyond `FAR_FLEXED_DEG` from where it is at rest."""
    joints, rest, names = body.joint_centres(), body.shaped.joints, body.shaped.body.joint_names
    at = {name: i for i, name in enumerate(names)}
    for side in ("L", "R"):
        shoulder, elbow = at[f"upperarm01.{side}"], at[f"lowerarm01.{side}"]
        if "arms" in limbs and joints[elbow, 1] > joints[shoulder, 1]:
            return True
        hip, knee = at[f"upperleg01.{side}"], at[f"lowerleg01.{side}"]
        now, before = joints[knee] - joints[hip], rest[knee] - rest[hip]
        cosine = now @ before / (np.linalg.norm(now) * np.linalg.norm(before))
        if "legs" in limbs and cosine < np.cos(np.radians(FAR_FLEXED_DEG)):
            return True
    return False


def _waist_slip_mm(draper: Draper, config: PoseConfig) -> float:
    """Mean distance of the waistband from where its skin carries it from where it was put on."""
    pose = sample_pose(draper.person, GARMENTS[draper.config.garment].limbs, config, np.random.default_rng(0))
    body, loop = with_pose(draper.person, pose, np.zeros(3)), draper.mesh.loops["waist"]
    carried = skin(draper.rest[loop], draper.skin_weights[loop], body.transforms)
    return 1e3 * float(np.linalg.norm(draper.drape(pose).vertices[loop] - carried, axis=1).mean())
