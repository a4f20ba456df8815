"""Settings of the virtual 4D scanner: the rig, the sensor's noise, the fusion.

The defaults come from measurements on a simulated T-shirt (see docs/scanner.md for the figures and the command that
prints them). Lengths are metres unless the name says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

__all__ = ["FusionConfig", "NoiseConfig", "RigConfig", "ScanConfig", "ScannerConfig", "ShadingConfig"]


@dataclass(frozen=True, slots=True)
class RigConfig:
    """Where the cameras stand."""

    cameras: int = 48
    """How many; 20 to 48 are sensible."""
    image_size: int = 560
    """Width and height of the square images, pixels."""
    field_of_view_deg: float = 48.0
    """Full horizontal angle of view."""


@dataclass(frozen=True, slots=True)
class NoiseConfig:
    """What the depth sensor does to the true depth."""

    sigma_m: float = 0.0003
    """Standard deviation of the depth at `reference_depth_m`, seen head-on. It grows with the square of the depth."""
    reference_depth_m: float = 1.5
    """Depth at which `sigma_m` holds."""
    correlation_px: float = 2.0
    """Width of the Gaussian that correlates neighbouring pixels, as stereo matching windows do."""
    grazing_floor: float = 0.25
    """Noise grows with 1/cos of the angle to the surface normal, down to this cosine."""
    silhouette_step_m: float = 0.013
    """A larger step of depth between neighbouring pixels is a silhouette: both sides are lost."""
    silhouette_loss: float = 0.5
    """Share of the next two pixels that is lost as well, in blobs."""
    lost_cosine: float = 0.2
    """Surfaces seen flatter than this cosine are lost."""
    weak_cosine: float = 0.35
    """Surfaces seen flatter than this cosine are lost in blobs."""
    weak_loss: float = 0.38
    """Share of the weakly seen surface that is lost."""
    blob_loss: float = 0.01
    """Share of any surface that is lost in blobs."""
    blob_px: float = 5.0
    """Size of the blobs."""


@dataclass(frozen=True, slots=True)
class ShadingConfig:
    """What light and lens do to the colours."""

    ambient: float = 0.72
    """Share of the light that comes from everywhere; the rest comes from two lamps."""
    camera_gain: float = 0.03
    """Standard deviation of each camera's exposure."""
    pixel_noise: float = 0.015
    """Standard deviation of a pixel's colour, 1 = full scale."""


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """Fusion of the depth images by truncated signed distances, and the cleaning of the result."""

    garment_voxel_m: float = 0.0027
    body_voxel_m: float = 0.005
    truncation_voxels: float = 3.0
    """Open3D's default of 8 lets both sides of a sleeve interfere: four times the error."""
    min_weight: float = 2.0
    """Cameras that must have seen a voxel."""
    block_resolution: int = 8
    """Voxels along the edge of a block of the sparse grid."""
    inside: bool = False
    """Scan the inside of open sheets too, where it is seen, as a sheet of its own. Off, it is too dark to be scanned:
    the inside of hems and sleeves is a hole."""
    thickness_m: float = 0.001
    """Of open sheets: how far behind its outside their inside is scanned."""
    min_component_faces: int = 400
    """Smaller connected pieces are dropped."""


@dataclass(frozen=True, slots=True)
class ScannerConfig:
    """The virtual 4D scanner."""

    rig: RigConfig = field(default_factory=RigConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    shading: ShadingConfig = field(default_factory=ShadingConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)


@dataclass(frozen=True, slots=True)
class ScanConfig:
    """How a sequence of meshes becomes a capture."""

    height_m: float | None = None
    """Scale the sequence so that its first frame is this tall; None keeps the sizes as metres."""
    up: Literal["x", "y", "z"] = "y"
    """The axis of the meshes that points up."""
    fps: float = 60.0
    """Frames per second of the sequence."""
    first_frame: int = 0
    """Index of the first mesh to scan."""
    frames: int | None = None
    """How many meshes to scan; None scans all."""
    step: int = 1
    """Scan every n-th mesh."""
    garment_colour: str = "#2f62c9"
    """Colour of the surface."""
    border_paint_m: float = 0.012
    """Width of the painted band along open borders; 0 paints none."""
    border_colours: tuple[str, ...] = ("#ffd200", "#e5332a", "#31b04a", "#f07be0", "#35c6d6", "#f28c1e")
    """Paint of the border loops, the longest loop first; fewer colours than loops are used in turn."""
    template_vertices: int | None = None
    """Size of the template, made from the first frame by decimation; None takes the first mesh itself. Ignored where a
    template is given."""
    seed: int = 0
    """Of the sensor noise."""
    scanner: ScannerConfig = field(default_factory=ScannerConfig)
