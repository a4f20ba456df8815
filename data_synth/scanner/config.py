"""Settings of the virtual 4D scanner: the rig, the sensor's noise, the fusion.

The defaults come from measurements on a simulated T-shirt (see docs/methods/scanner.md for the figures and the command
that prints them). Lengths are metres unless the name says otherwise.
"""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from capture4d.settings import Count, NonNegative, Odd, Part, Positive, Range, Seed, Share, Whole, settings

__all__ = [
    "FusionConfig",
    "Lighting",
    "NoiseConfig",
    "RigConfig",
    "ScanConfig",
    "ScannerConfig",
    "ShadingConfig",
    "StereoConfig",
]

Lighting = Literal["even", "side", "two-temperature", "overhead"]
Cameras = Annotated[int, Range(least=4)]  # fewer leave a side of the subject unseen
FieldOfView = Annotated[float, Range(above=0, below=180)]


@settings
class RigConfig:
    """Where the cameras stand."""

    cameras: Cameras = 48
    """How many; 20 to 48 are sensible."""
    image_size: Count = 560
    """Width and height of the square images, pixels."""
    field_of_view_deg: FieldOfView = 48.0
    """Full horizontal angle of view."""


@settings
class NoiseConfig:
    """What the depth sensor does to the true depth."""

    sigma_m: NonNegative = 0.0003
    """Standard deviation of the depth at `reference_depth_m`, seen head-on. It grows with the square of the depth."""
    reference_depth_m: Positive = 1.5
    """Depth at which `sigma_m` holds."""
    correlation_px: NonNegative = 2.0
    """Width of the Gaussian that correlates neighbouring pixels, as stereo matching windows do."""
    grazing_floor: Annotated[float, Range(above=0, most=1)] = 0.25
    """Noise grows with 1/cos of the angle to the surface normal, down to this cosine."""
    silhouette_step_m: Positive = 0.013
    """A larger step of depth between neighbouring pixels is a silhouette: both sides are lost."""
    silhouette_loss: Part = 0.5
    """Share of the next two pixels that is lost as well, in blobs."""
    lost_cosine: Share = 0.2
    """Surfaces seen flatter than this cosine are lost."""
    weak_cosine: Share = 0.35
    """Surfaces seen flatter than this cosine are lost in blobs."""
    weak_loss: Part = 0.38
    """Share of the weakly seen surface that is lost."""
    blob_loss: Part = 0.01
    """Share of any surface that is lost in blobs."""
    blob_px: NonNegative = 5.0
    """Size of the blobs."""


@settings
class ShadingConfig:
    """What light and lens do to the colours."""

    lighting: Lighting = "even"
    """even: from everywhere, and two weak lamps. side: one near lamp at the subject's left, whose light falls off.
    two-temperature: a warm lamp at the left, a cool one at the right. overhead: one lamp above and before the subject,
    whose strength and tint are 3 % off in every frame."""
    ambient: Share = 0.72
    """Under even light, the share that comes from everywhere; the rest comes from two lamps."""
    camera_gain: NonNegative = 0.03
    """Standard deviation of each camera's exposure."""
    pixel_noise: NonNegative = 0.015
    """Standard deviation of a pixel's colour, 1 = full scale."""


@settings
class FusionConfig:
    """Fusion of the depth images by truncated signed distances, and the cleaning of the result."""

    garment_voxel_m: Positive = 0.0027
    """Edge of a voxel near the garment, metres."""
    body_voxel_m: Positive = 0.005
    """The same near the body."""
    truncation_voxels: Positive = 3.0
    """Open3D's default of 8 lets both sides of a sleeve interfere: four times the error."""
    min_weight: NonNegative = 2.0
    """Cameras that must have seen a voxel."""
    block_resolution: Count = 8
    """Voxels along the edge of a block of the sparse grid."""
    inside: bool = False
    """Scan the inside of open sheets too, where it is seen, as a sheet of its own. Off, it is too dark to be scanned:
    the inside of hems and sleeves is a hole."""
    thickness_m: NonNegative = 0.001
    """Of open sheets: how far behind its outside their inside is scanned."""
    min_component_faces: Whole = 400
    """Smaller connected pieces are dropped."""


@settings
class StereoConfig:
    """Active stereo: pods of two cameras with a speckle projector between them, instead of depth cameras."""

    pods: Cameras = 14
    """How many; they stand where the depth cameras of a rig of this size would."""
    image_size: Count = 1280
    """Width and height of the square images, pixels. With 768 the hems of scans end askew: matches there mix cloth and
    leg within the matcher's window."""
    field_of_view_deg: FieldOfView = 48.0
    """Full horizontal angle of view."""
    baseline_m: Positive = 0.2
    """Between the two cameras of a pod."""
    supersampling: Count = 1
    """Rays along each side of a pixel of the speckle images."""
    speckle_px: Positive = 0.9
    """Standard deviation of a speckle's profile, camera pixels."""
    ambient: NonNegative = 0.06
    """Light that reaches the surface without the pattern, relative to the projector's, head-on at the pod's target."""
    blur_px: NonNegative = 0.6
    """Standard deviation of the lens's blur."""
    full_well: Positive = 9000.0
    """Electrons of a white pixel; their square root is the shot noise."""
    read_noise: NonNegative = 12.0
    """Electrons, standard deviation."""
    block_px: Annotated[Count, Odd] = 5
    """Width of the matcher's window."""
    uniqueness_percent: Annotated[int, Range(least=0, most=100)] = 8
    """Margin by which the best disparity has to beat the others."""
    speckle_window_px: Whole = 400
    """Smaller islands of disparity are dropped."""
    refinement_steps: Whole = 4
    """Of the matches, on the intensities. Semi-global matching alone is up to 0.3 pixels off, towards whole ones; 4
    steps leave less than 0.1 on a wall. 0 leaves it out."""
    lost_intensity: Share = 0.02
    """Darker pixels, 1 = full scale, are not matched: background, and what the projector does not reach."""
    step_m: NonNegative = 0.012
    """Pixels at a larger step of depth are dropped from the cleaned depth; 0 leaves the depth raw."""
    min_weight: NonNegative = 1.0
    """Pods that must have seen a voxel. Pods overlap little."""


@settings
class ScannerConfig:
    """The virtual 4D scanner."""

    sensor: Literal["depth", "stereo"] = "depth"
    """depth: cameras that measure depth, with modelled noise. stereo: pairs of images under a speckle pattern, matched
    (slower; fattened silhouettes, flyers and shadows are those of a real matcher)."""
    stereo: StereoConfig = field(default_factory=StereoConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    shading: ShadingConfig = field(default_factory=ShadingConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)


@settings
class ScanConfig:
    """How a sequence of meshes becomes a capture."""

    height_m: Positive | None = None
    """Scale the sequence so that its first frame is this tall; if absent, sizes are metres."""
    up: Literal["x", "y", "z"] = "y"
    """The axis of the meshes that points up."""
    fps: Positive = 60.0
    """Frames per second of the sequence."""
    first_frame: Whole = 0
    """Index of the first mesh to scan."""
    frames: Count | None = None
    """How many meshes to scan; all if absent."""
    step: Count = 1
    """Scan every n-th mesh."""
    garment_colour: str = "#2f62c9"
    """Colour of the surface."""
    border_paint_m: NonNegative = 0.012
    """Width of the painted band along open borders; 0 paints none."""
    border_colours: tuple[str, ...] = ("#ffd200", "#e5332a", "#31b04a", "#f07be0", "#35c6d6", "#f28c1e")
    """Paint of the border loops, the longest loop first; fewer colours than loops are used in turn."""
    template_vertices: Annotated[int, Range(least=4)] | None = None
    """Size of the template, made from the first frame by decimation; the first mesh itself if absent. Ignored where a
    template is given."""
    seed: Seed = 0
    """Of the sensor noise."""
    scanner: ScannerConfig = field(default_factory=ScannerConfig)
