"""Settings of static drapes. Standard library only, so that the command line can list them at once."""

from __future__ import annotations

from dataclasses import field, fields
from typing import Annotated, Literal

from capture4d.settings import Count, NonNegative, Number, Positive, Range, Seed, Share, Whole, settings
from data_synth.config import GarmentStyle, Vertices

GarmentName = Literal["tshirt", "shirt", "trousers", "skirt", "necktie"]
Ease = Annotated[float, Range(least=-0.3, most=1)]
Limits = tuple[Number, Number]
HeldOut = Annotated[float, Range(least=0, below=0.5)]  # two such shares leave something to learn from


@settings
class ShirtStyle:
    """A shirt with long sleeves, relative to the person it is drafted for."""

    size: Positive = 1.0
    """Scale of the draft's widths; 1 fits the person before ease."""
    ease: Ease = 0.2
    """Girth beyond the chest's, as a fraction of it."""
    sleeve_length: Annotated[float, Range(least=0.2, most=1.1)] = 0.88
    """Underarm length of the sleeve, as a fraction of the arm from shoulder to wrist."""
    cuff_width: Annotated[float, Range(least=0.3, most=1.2)] = 0.6
    """Width of the sleeve at the cuff, as a fraction of that at the underarm."""
    hem_drop_m: Number = 0.12
    """How far below the hip joint the hem lies, metres."""


@settings
class TrousersStyle:
    """Trousers, relative to the person they are drafted for."""

    size: Positive = 1.0
    """Scale of the girths of waist and hip."""
    ease: Ease = 0.1
    """Girth beyond the hip's, as a fraction of it."""
    length: Annotated[float, Range(least=0.15, most=1.05)] = 0.95
    """Of the inseam, as a fraction of the way from the crotch to the ankle."""
    rise_m: Positive = 0.11
    """How far above the hip joint the waistband lies, metres."""
    hem_width: Annotated[float, Range(least=0.35, most=1.5)] = 0.62
    """Width of a leg at the hem, as a fraction of that at the crotch."""


@settings
class SkirtStyle:
    """A skirt, relative to the person it is drafted for."""

    size: Positive = 1.0
    """Scale of the girths of waist and hip."""
    ease: Ease = 0.06
    """Girth beyond the hip's, as a fraction of it."""
    length_m: Annotated[float, Range(least=0.2, most=0.9)] = 0.45
    """From the waist to the hem, metres."""
    flare: Annotated[float, Range(least=0.95, most=2.5)] = 1.45
    """Girth of the hem, as a multiple of the hip's."""
    rise_m: Positive = 0.11
    """How far above the hip joint the waist lies, metres."""


@settings
class NecktieStyle:
    """The blade of a necktie that hangs from its knot."""

    length_m: Annotated[float, Range(least=0.2, most=0.8)] = 0.56
    """From the knot to the tip, metres."""
    width_m: Annotated[float, Range(least=0.03, most=0.15)] = 0.09
    """At its widest, metres."""


Style = GarmentStyle | ShirtStyle | TrousersStyle | SkirtStyle | NecktieStyle
STYLES: dict[str, type] = {
    "tshirt": GarmentStyle,
    "shirt": ShirtStyle,
    "trousers": TrousersStyle,
    "skirt": SkirtStyle,
    "necktie": NecktieStyle,
}


@settings
class Cloth:
    """What a draped sheet is made of; it is the whole cloth, not a coarse stand-in that fine folds are put on."""

    density: Positive = 0.2
    """Mass of an area, kg/m2."""
    stretch_stiffness: Positive = 250.0
    """Of an edge, N/m."""
    compression_stiffness: Positive = 5.0
    """Of an edge that is shorter than at rest, N/m: what is pressed together wrinkles more finely than the mesh can,
    and hardly resists. As stiff as in tension it would snap into one large fold or another, whichever was near
    (tension field theory: Pipkin, The Relaxed Energy Density for Isotropic Elastic Membranes, 1986)."""
    over_relaxation: Annotated[float, Range(least=1, below=2)] = 1.55
    """Of the correction of stretched edges. One sweep a step leaves a hanging sheet longer than its stiffness would, a
    shirt by 9 mm; successive over-relaxation brings it there sooner. 1.3 leaves 5 mm, 1.9 takes three times as long."""
    strain_limit: Annotated[float, Range(least=1)] = 1.06
    """Beyond this share of its length an edge does not give at all."""
    compression_limit: Annotated[float, Range(least=0, most=1)] = 0.8
    """Nor below this one."""
    bending: Positive = 2e-5
    """Bending stiffness, N m. 1e-5 gives folds, 1e-4 few of them; beyond 1e-3 one sweep a step makes it no stiffer."""
    friction: NonNegative = 0.1
    """Coulomb coefficient between cloth and body."""


@settings
class Hold:
    """Soft springs to where the garment sat on the body when it was put on: seams, yoke and waistband keep it there."""

    hz: NonNegative
    """Frequency at which a vertex at the shoulders or the waistband would swing about its place."""
    depth_m: Positive
    """How far below that the hold has fallen to a third of the way to `floor`."""
    floor: Share
    """Share of the hold far below."""


CLOTHS: dict[str, Cloth] = {
    "tshirt": Cloth(bending=5e-5),
    "shirt": Cloth(bending=5e-5),
    "trousers": Cloth(density=0.28, bending=4e-5),
    "skirt": Cloth(density=0.22, bending=3e-5),
    # A blade is short, and hardly sags.
    "necktie": Cloth(density=0.45, stretch_stiffness=600.0, bending=4e-4, over_relaxation=1.0),
}
HOLDS: dict[str, Hold] = {
    "tshirt": Hold(hz=10.0, depth_m=0.09, floor=0.07),
    "shirt": Hold(hz=10.0, depth_m=0.09, floor=0.07),
    "trousers": Hold(hz=40.0, depth_m=0.04, floor=0.01),
    "skirt": Hold(hz=25.0, depth_m=0.04, floor=0.0),
    "necktie": Hold(hz=0.0, depth_m=0.04, floor=0.0),
}


@settings
class SolverConfig:
    """How a drape comes to rest."""

    way: Count = 6
    """Parts of the way from the dressing pose, in each of which the cloth is carried along by its skin weights."""
    way_substeps: Count = 24
    """Substeps, 1/1440 s each, in each part."""
    contact_substeps: Count = 12
    """Substeps from one look-up of the body to the next."""
    still_mm: Positive = 0.1
    """At rest: the mean motion in 1/60 s is below this, millimetres."""
    frames: Annotated[int, Range(least=1, most=100)] = 90
    """Sixtieths of a second after which a drape that still moves is flagged; three times as many for what is pinned."""
    keep: Annotated[float, Range(least=0.9, most=1)] = 0.99
    """Share of the velocity that is left after a substep."""
    calm_after_frames: Whole = 16
    """Sixtieths of a second after which every further one damps as much more: what is pinched in a crease of the body
    never rests by itself. What is pinned is not: it swings, and damped it would creep."""
    margin_m: NonNegative = 0.005
    """Distance at which the cloth lies over the body, metres; that of the moving simulator."""


@settings
class PoseConfig:
    """How poses are drawn, and the ranges of the joints in degrees, (least, most).

    No range goes beyond what healthy adults reach, American Academy of Orthopaedic Surgeons, Joint Motion: Method of
    Measuring and Recording (1965): spine 80 forward, 25 backward, 35 to a side, 45 turned; neck 45, 45, 45, 60;
    shoulder 180 up; elbow 150; hip 120 forward, 30 backward, 45 outward, 30 inward, 45 turned; knee 135. Spine and neck
    are split over two joints each.
    """

    distribution: Literal["half-normal", "uniform"] = "half-normal"
    """Of spine, neck and legs: a half-normal on either side of rest, its limit at two standard deviations, or uniform
    in the range. Jin et al. have the first in their appendix and the second in their text."""
    spine_bend: Limits = (-10.0, 35.0)
    """Of each of two joints: backward, forward."""
    spine_turn: Limits = (-20.0, 20.0)
    """Of each of two joints: to the right, to the left."""
    spine_side: Limits = (-15.0, 15.0)
    """Of each of two joints: to either side."""
    neck_bend: Limits = (-15.0, 20.0)
    """Of each of two joints: backward, forward."""
    neck_turn: Limits = (-28.0, 28.0)
    """Of each of two joints: to the right, to the left."""
    neck_side: Limits = (-15.0, 15.0)
    """Of each of two joints: to either side."""
    arm_azimuth: Limits = (-30.0, 110.0)
    """Turns the arm forward about the vertical; uniform."""
    arm_altitude: Limits = (-80.0, 75.0)
    """Above the horizontal; uniform in its sine, so that directions are as dense everywhere."""
    arm_twist: Limits = (-35.0, 35.0)
    """Of the upper arm about itself; uniform."""
    elbow: Limits = (0.0, 110.0)
    """Bends it beyond the rest pose; uniform."""
    collar_bone_share: Share = 0.12
    """Part of the arm's rise and of its turn forward that the collar bone does."""
    hip_flexion: Limits = (-15.0, 100.0)
    """Backward, forward."""
    hip_abduction: Limits = (-10.0, 40.0)
    """Inward, outward, from the rest pose."""
    hip_rotation: Limits = (-30.0, 30.0)
    """Of the thigh about itself: inward, outward."""
    knee: Limits = (0.0, 130.0)
    """Bends it."""

    def __post_init__(self) -> None:
        for each in fields(self):
            limits = getattr(self, each.name)
            if isinstance(limits, tuple) and limits[0] > limits[1]:
                raise SettingError(self, each.name, "the least first", limits[0])


@settings
class DrapesConfig:
    """A set of drapes: one garment of one style on one person, in many poses."""

    garment: GarmentName = "tshirt"
    """What is draped; each kind has a pattern and style parameters of its own."""
    samples: Count = 100
    """Poses to drape; those of bad drapes are kept and marked, and belong to no part of the split."""
    seed: Seed = 0
    """Everything random follows from it; equal seeds give equal files."""
    style: tuple[str, ...] = ()
    """Of the garment, NAME=VALUE each: size, ease, and what else its pattern has."""
    beta: tuple[Number, ...] = ()
    """Shape of the person, in standard deviations: the first is height, the second girth."""
    drafted_for: Literal["mean", "wearer"] = "mean"
    """Whom the pattern is drafted for: the mean person whoever wears it, as what is bought in one size, or the wearer,
    as what is made to measure. The mesh is the same."""
    vertices: Vertices = 3000
    """Of the garment's mesh."""
    skirt_weights: Literal["distance", "root"] = "distance"
    """How a skirt follows the body: by the mean of the skin around it, weighted by inverse distance, or the hips
    alone."""
    validation: HeldOut = 0.1
    """Share of the good drapes that is not learned from, but tells when to stop."""
    test: HeldOut = 0.1
    """Share of the good drapes for tests alone; a pose is in one part."""
    shard: Annotated[int, Range(least=1, most=4096)] = 64
    """Drapes in a file."""
    garment_seed: Whole = 0
    """Of the mesh: equal for sets that are to have one topology."""
    poses: PoseConfig = field(default_factory=PoseConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
