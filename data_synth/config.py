"""Settings of the synthetic scanner. Standard library only, so that the command line can list them at once."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Annotated, Literal

from capture4d.settings import Count, NonNegative, Number, Part, Positive, Range, Seed, Share, Whole, settings
from data_synth.cloth.fabrics import Shrink
from data_synth.outfits import OutfitName, PrintName
from data_synth.scanner.config import FusionConfig, RigConfig, ScannerConfig, StereoConfig

ClipName = Literal[
    "range-of-motion", "twist", "reach", "side-bend", "walk", "hop", "arm-circles", "reach-twist", "lunge", "squat",
    "sit", "reach-down", "range-of-legs", "sampled",
]  # fmt: skip
GarmentKind = Literal["shirt", "trousers", "skirt"]

Vertices = Annotated[int, Range(least=100)]  # fewer are too few to sew a shirt from


@settings
class MotionConfig:
    """What the subject does."""

    clip: ClipName = "range-of-motion"
    """A scripted clip, or random poses within joint limits (sampled)."""
    bvh: str | None = None
    """A BVH file to follow instead of a clip."""
    skip_frames: Whole = 0
    """Frames to leave out at the start of the motion, 60 a second."""
    seed: Seed = 0
    """Varies the motion of the same subject in the same garment."""
    reverse: bool = False
    """Backwards in time."""


@settings
class GarmentStyle:
    """A T-shirt, relative to the person it is drafted for."""

    size: Positive = 1.0
    """Scale of the draft's widths; 1 fits the person before ease."""
    ease: Annotated[float, Range(above=-1)] = 0.22
    """Girth beyond the chest's, as a fraction of it; below 0.12 a shirt is nearly free of folds."""
    sleeve_length: Positive = 0.62
    """Underarm length of the sleeve, as a fraction of the upper arm."""
    hem_drop_m: Number = 0.12
    """How far below the hip joint the hem lies, metres."""


@settings
class SimulationConfig:
    """The coarse simulation."""

    vertices: Vertices = 2500
    """Vertices of the simulated sheet."""
    fps: Positive = 60.0
    """Frames that are simulated a second."""
    substeps: Count = 32
    """Steps a frame. Many short ones converge far better than many iterations: on a sheet of 5,000 vertices the hem of
    48 x 1 hangs as high as that of 32 x 2, at three quarters of the cost, and that of 24 x 2 higher than that of
    16 x 3."""
    iterations: Count = 1
    """Vertex block descent sweeps a substep."""
    calm_frames: Count = 18
    """Frames in the dressing pose in which the panels close on the body."""
    approach_frames: Count = 24
    """Frames from the dressing pose to the clip's first pose."""
    rest_frames: Whole = 12
    """Frames at rest before the clip starts."""
    contact_gap_m: NonNegative = 0.008
    """Distance from the body at which the contact of the cloth is looked for, metres."""
    contact_substeps: Count = 3
    """Substeps from one search for contacts to the next."""
    damping: Share = 0.993
    """Share of the velocity kept each substep."""
    calm_damping: Share = 0.85
    """The same in the calm frames."""
    hold_hz: NonNegative = 17.0
    """Frequency at which a vertex at the shoulders would swing about its place on the body: how firmly the shirt keeps
    its seat. 0 leaves the sheet free, and its folds at the shoulders to its history."""
    hold_depth_m: Positive = 0.09
    """How far below the shoulders the hold has fallen to a third of the way to `hold_floor`."""
    hold_floor: Share = 0.035
    """Share of the hold far below the shoulders."""
    hold_ripple_m: NonNegative = 0.007
    """Standard deviation of the fixed bumps of that place, metres. They say which way the cloth buckles when the arms
    go up; without them a tenth of a millimetre decides, and two runs that had met part again."""
    hold_ripple_width_m: tuple[NonNegative, NonNegative] = (0.012, 0.02)
    """Width of the bumps across and along the grain."""


@settings
class RelaxationConfig:
    """The fine folds."""

    vertices: Vertices = 80_000
    """Vertices of the wrinkle mesh."""
    sweeps: Whole = 20
    """Gauss-Seidel sweeps a frame. Fewer let the folds lag behind the pose a little, which calms them: while arms rise,
    flicker is 1.40 with 20 sweeps and 1.44 with 30."""
    start_sweeps_factor: Count = 12
    """How many times more where there is no frame before."""
    pull_normal: Share = 0.001
    """Pull towards the coarse sheet along its normal, per sweep."""
    pull_tangential: Share = 0.0005
    """The same in the sheet's plane."""
    radius_m: NonNegative = 0.012
    """No vertex leaves the coarse sheet farther than this."""
    body_margin_m: NonNegative = 0.003
    """Clearance to the body."""
    warm_start: Share = 0.945
    """Share of the folds carried over from the frame before; the rest is the imperfection. 1 moves most smoothly, but
    then the folds are an accident of the start; below 0.5 they shimmer."""
    imperfection_m: NonNegative = 0.003
    """Standard deviation of the imperfection, metres. Larger makes the folds follow the pose, not the history: with
    1 mm two runs that meet differ by 0.45 of the residual at warm start 0.85, with 2 mm by 0.32."""
    imperfection_width_m: tuple[NonNegative, NonNegative] = (0.0085, 0.045)
    """Width of the imperfection across and along the grain; white noise would fold the cloth into crepe."""


@settings
class FoldConfig:
    """A garment whose folds are here and there, deep, with calm cloth between; in place of excess cloth everywhere."""

    shrink: tuple[Shrink, Shrink] = (0.949, 0.982)
    """Size of the coarse rest pattern across and along the grain, in the mean; in place of the fabric's."""
    calm_shrink: tuple[Shrink, Shrink] = (0.998, 0.998)
    """The same on chest and shoulder blades of a shirt."""
    patch_spread: NonNegative = 1.9
    """Standard deviation of the logarithm of the excess across, from patch to patch."""
    patch_width_m: tuple[NonNegative, NonNegative] = (0.05, 0.12)
    """Width of the patches across and along the grain."""
    most_excess: Part = 0.17
    """No patch has more than this across."""
    wide: RelaxationConfig = field(
        default_factory=lambda: RelaxationConfig(
            vertices=12_000,
            sweeps=30,
            radius_m=0.03,
            pull_normal=0.0005,
            imperfection_m=0.005,
            imperfection_width_m=(0.02, 0.08),
        )
    )
    """Wide folds, on a mesh between the simulated one and that of the fine folds."""
    wide_share: Share = 0.6
    """Share of the excess that wide folds take up; the rest is left to fine ones."""
    wide_bending: Share = 0.17
    """Bending gain of the wide folds."""
    last_sweeps: Whole = 80
    """Sweeps over nearly unbent cloth at the end, in which it gets its lengths back."""
    last_bending: Share = 0.002
    """Bending gain in them."""
    over_relaxation: Annotated[float, Range(least=1, below=2)] = 1.7
    """Of the lengths in them."""
    slack: Share = 0.3
    """Share of a correction that an edge gets in them that is too long: cloth buckles before it is compressed."""
    untangle_steps: Whole = 24
    """Steps, on each mesh of folds, in which faces that cut each other are drawn apart; 0 leaves them."""
    sheet_steps: Whole = 4
    """The same after every simulated frame of the sheet: what has only just passed through itself parts easily."""
    sideways: Share = 0.1
    """How firmly the sheet keeps its area, as a share of its stiffness. At 1 it shrinks across by a third of what it is
    stretched along, and what has shrunk does not fold."""
    hold_spread: Whole = 25
    """Passes over the simulated sheet that smooth which limbs its hold follows. Where the skin folds sharply, above a
    raised shoulder, cloth does not."""
    strip_m: NonNegative = 0.02
    """Width of the turned layer along every border."""
    strip_mass: Annotated[float, Range(least=1)] = 2.0
    """Mass of it over that of one layer."""
    strip_bending: Annotated[float, Range(least=1)] = 4.0
    """Bending stiffness of it over that of one layer."""
    seam_bending: Annotated[float, Range(least=1)] = 3.0
    """Bending stiffness of a seam over that of one layer."""
    strip_thickness_m: NonNegative = 0.001
    """How far it stands out."""
    wall_hz: NonNegative = 20.0
    """Frequency at which cloth of a sleeve that has passed the plane between arm and trunk would swing back; 0 lets
    sleeve and trunk pass through each other."""


@settings
class SynthConfig:
    """One synthetic take: who, what, how it moves, how it is scanned."""

    name: str = "tshirt"
    """Of the capture."""
    seed: Seed = 0
    """Everything random follows from it; equal seeds give equal files."""
    frames: Count = 120
    """Frames of the capture."""
    capture_every: Count = 1
    """Simulated frames (60 a second) per captured frame."""
    body_shape: tuple[Number, ...] = ()
    """Shape coefficients of the subject, in standard deviations: the first is height, the second girth."""
    drafted_for: tuple[Number, ...] | None = None
    """Shape of the person for whom the garment was drafted and meshed, if it is somebody else: the same garment, vertex
    for vertex, graded to the subject."""
    scans: bool = True
    """Off: the cloth and its truth alone."""
    mocap_noise_deg: NonNegative = 0.3
    """Error of the joint angles in the capture's poses.npz, standard deviation; truth/ holds the exact ones."""
    template_vertices: Vertices = 5000
    """Vertices of the registration template."""
    fabric: Literal["jersey", "shirt-cotton", "linen", "denim", "wool", "twill"] = "jersey"
    """What the garment is made of."""
    garment: GarmentKind | None = None
    """What is worn instead of a T-shirt: a shirt with long sleeves, trousers, or a skirt."""
    cut: tuple[str, ...] | None = None
    """Of such a garment, NAME=VALUE each, as the styles of static drapes are given: size, ease, and what else its
    pattern has."""
    skirt_weights: Literal["distance", "root"] | None = None
    """How the template of a skirt follows the body: by the mean of the skin around it, weighted by inverse distance
    (also if absent), or the hips alone."""
    style: GarmentStyle = field(default_factory=GarmentStyle)
    outfit: OutfitName = "blue"
    """Colours of garment, border paint and suit."""
    print: PrintName | None = None
    """What is printed on the cloth: random blobs of all colours but the paint's, stripes, checks, or a logo on the
    chest. Nothing if absent."""
    print_mm: Positive | None = None
    """Size of the print's features, millimetres: blobs, stripes, squares, details of the logo; 10 if absent."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    relaxation: RelaxationConfig = field(default_factory=RelaxationConfig)
    folds: FoldConfig | None = field(default_factory=FoldConfig)
    """Folds here and there; if absent, everywhere alike."""
    scanner: ScannerConfig = field(default_factory=ScannerConfig)


def _small_folds(wide_vertices: int) -> FoldConfig:
    return FoldConfig(wide=replace(FoldConfig().wide, vertices=wide_vertices))


_FULL = SynthConfig(name="tshirt-200k")
_TINY = replace(
    _FULL,
    name="tiny",
    frames=6,
    capture_every=4,
    template_vertices=1500,
    simulation=SimulationConfig(vertices=800, contact_substeps=2, approach_frames=16, rest_frames=8),
    relaxation=RelaxationConfig(vertices=12_000, sweeps=40),
    folds=_small_folds(1800),
    scanner=ScannerConfig(
        stereo=StereoConfig(pods=10, image_size=384, supersampling=1, speckle_window_px=60),
        rig=RigConfig(cameras=24, image_size=320),
        fusion=FusionConfig(garment_voxel_m=0.005, body_voxel_m=0.009, min_component_faces=120),
    ),
)
_SHIRTS: tuple[SynthConfig, ...] = (
    replace(
        _FULL,
        name="demo",
        frames=36,
        capture_every=3,
        simulation=SimulationConfig(calm_frames=14, approach_frames=16, rest_frames=8),
    ),
    _TINY,
    # There and back: the clip ends in the pose it began with, so that drift can be told from the pose.
    replace(_FULL, frames=212),
    replace(_FULL, name="tshirt-cotton-200k", fabric="shirt-cotton", seed=1),
    replace(_FULL, name="tshirt-linen-200k", fabric="linen", seed=2),
)


def _at_waist(simulation: SimulationConfig, hold_hz: float) -> SimulationConfig:
    """A waistband keeps its seat with a firm hold: its few centimetres carry the whole garment."""
    return replace(simulation, hold_hz=hold_hz, hold_depth_m=0.04, hold_floor=0.02, hold_ripple_m=0.0)


_WHOLE_PERSON = ScannerConfig(rig=RigConfig(image_size=800))
"""Cameras stand farther away where the whole person is in view, and need more pixels."""
_SHIRT = replace(_FULL, name="shirt-200k", garment="shirt", fabric="shirt-cotton", frames=212)
_TROUSERS = replace(
    _FULL,
    name="trousers-200k",
    garment="trousers",
    cut=("ease=0.2",),  # at the 0.1 of a still person, squatting stretches the seat by a fifth
    fabric="twill",
    frames=186,
    motion=MotionConfig("range-of-legs"),
    simulation=_at_waist(SimulationConfig(), 120.0),
    scanner=_WHOLE_PERSON,
)
_SKIRT = replace(_TROUSERS, name="skirt-200k", garment="skirt", cut=None, fabric="shirt-cotton")


def _small(full: SynthConfig, name: str, motion: ClipName) -> SynthConfig:
    """The same garment as coarse as the preset `tiny`, in the first second of a clip."""
    coarse = replace(_TINY.simulation, calm_frames=14, approach_frames=8, rest_frames=4)
    return replace(
        full,
        name=name,
        frames=14,
        capture_every=4,
        template_vertices=_TINY.template_vertices,
        motion=MotionConfig(motion),
        simulation=coarse if full.garment == "shirt" else _at_waist(coarse, 80.0),
        relaxation=_TINY.relaxation,
        folds=_TINY.folds,
        scanner=replace(
            _TINY.scanner,
            rig=RigConfig(cameras=32, image_size=400 if full.garment == "shirt" else 600),
            fusion=replace(_TINY.scanner.fusion, body_voxel_m=0.007, min_component_faces=60),
        ),
    )


_OTHERS: tuple[SynthConfig, ...] = (
    _SHIRT,
    _TROUSERS,
    _SKIRT,
    _small(_SHIRT, "shirt-demo", "reach"),
    _small(_TROUSERS, "trousers-demo", "squat"),
    _small(_SKIRT, "skirt-demo", "lunge"),
)
PRESETS: dict[str, SynthConfig] = {take.name: take for take in (*_SHIRTS, *_OTHERS)}
"""Takes by name, from minutes to an hour."""


@settings
class TrainingSetConfig:
    """Takes to learn a garment from: one subject, one garment, one template, many clips."""

    name: str
    takes: dict[str, SynthConfig]
    """Clips by name; every one starts from the same seed and so wears the same garment."""
    held_out: tuple[str, ...]
    """Clips that are not learned from."""
    reversed: tuple[str, ...]
    """Clips that run backwards, not learned from either."""
    bodies: dict[str, tuple[Number, ...]]
    """Other people, by shape coefficients. The held-out clips are simulated on each, without scans, in the same garment
    graded to them."""


OTHER_BODIES: dict[str, tuple[float, ...]] = {
    "thin": (0.0, -2.0),
    "heavy": (0.0, 2.0),
    "tall": (1.5, 0.0),
    "short": (-1.5, 0.0),
}


def _clips(base: SynthConfig, clips: dict[str, MotionConfig]) -> dict[str, SynthConfig]:
    """Clips that run backwards are half as long."""
    return {
        name: replace(
            base,
            name=f"{base.name}-{name}",
            motion=motion,
            frames=base.frames // 2 if motion.reverse else base.frames,
        )
        for name, motion in clips.items()
    }


_TRAIN = replace(PRESETS["tshirt-200k"], name="tshirt-train", frames=150)
_TINY_TRAIN = replace(
    _TINY,
    name="tiny-train",
    frames=16,
    capture_every=2,
    template_vertices=700,
    simulation=replace(_TINY.simulation, vertices=600, calm_frames=12, approach_frames=10, rest_frames=4),
    relaxation=RelaxationConfig(vertices=4_000, sweeps=20),
    folds=_small_folds(600),
)
TRAINING_SETS: dict[str, TrainingSetConfig] = {
    "tshirt-train": TrainingSetConfig(
        "tshirt-train",
        _clips(
            _TRAIN,
            {
                "range-of-motion": MotionConfig("range-of-motion"),
                "twist": MotionConfig("twist"),
                "reach": MotionConfig("reach"),
                "side-bend": MotionConfig("side-bend"),
                "walk": MotionConfig("walk"),
                "hop": MotionConfig("hop"),
                "sampled-1": MotionConfig("sampled", seed=1),
                "sampled-2": MotionConfig("sampled", seed=2),
                "sampled-4": MotionConfig("sampled", seed=4),
                "sampled-5": MotionConfig("sampled", seed=5),
                "sampled-6": MotionConfig("sampled", seed=6),
                "reach-twist": MotionConfig("reach-twist"),
                "sampled-3": MotionConfig("sampled", seed=3),
                "twist-reversed": MotionConfig("twist", skip_frames=75, reverse=True),
                "sampled-3-reversed": MotionConfig("sampled", skip_frames=75, seed=3, reverse=True),
            },
        ),
        held_out=("reach-twist", "sampled-3"),
        reversed=("twist-reversed", "sampled-3-reversed"),
        bodies=OTHER_BODIES,
    ),
    "tiny-train": TrainingSetConfig(
        "tiny-train",
        _clips(
            _TINY_TRAIN,
            {
                "twist": MotionConfig("twist"),
                "reach": MotionConfig("reach"),
                "reach-twist": MotionConfig("reach-twist"),
                "twist-reversed": MotionConfig("twist", reverse=True),
            },
        ),
        held_out=("reach-twist",),
        reversed=("twist-reversed",),
        bodies=OTHER_BODIES,
    ),
}
"""Sets of takes by name. `tshirt-train` has 2,100 frames with scans and 1,200 without, which by the costs that
`python -m benchmarks synthesis` prints is about 13,000 CPU seconds; `tiny-train` is its small likeness."""


@settings
class BoardConfig:
    """A board and how it is waved about."""

    board: str = "charuco:8x6:100:74:DICT_4X4_50"
    """charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY."""
    poses: Count = 24
    """Of the board, one photograph of each camera in each."""
    seed: Seed = 0
    """Everything random follows from it."""
