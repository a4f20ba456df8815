"""Settings out of range, told in one line before any work begins."""

from __future__ import annotations

from capture4d.errors import InputError
from data_synth.config import SynthConfig
from data_synth.scanner.config import ScanConfig, ScannerConfig

__all__ = ["check_scan", "check_synth"]

FEWEST_CAMERAS = 4


def check_synth(config: SynthConfig) -> None:
    """See that a take can be made at all.

    Raises:
        InputError: a setting is out of range; the message names it as the command line does.
    """
    simulation = config.simulation
    _at_least(1, "--frames", config.frames)
    _at_least(1, "--capture-every", config.capture_every)
    _at_least(0, "--seed", config.seed)
    _at_least(0, "--mocap-noise-deg", config.mocap_noise_deg)
    _at_least(0, "--motion.skip-frames", config.motion.skip_frames)
    _positive("--simulation.fps", simulation.fps)
    _at_least(1, "--simulation.substeps", simulation.substeps)
    _at_least(1, "--simulation.iterations", simulation.iterations)
    _at_least(1, "--simulation.contact-substeps", simulation.contact_substeps)
    _at_least(1, "--simulation.calm-frames", simulation.calm_frames)
    _at_least(1, "--simulation.approach-frames", simulation.approach_frames)
    _at_least(0, "--simulation.rest-frames", simulation.rest_frames)
    _at_least(0, "--relaxation.sweeps", config.relaxation.sweeps)
    _check_scanner(config.scanner)


def check_scan(config: ScanConfig) -> None:
    """See that a sequence of meshes can be scanned at all.

    Raises:
        InputError: a setting is out of range; the message names it as the command line does.
    """
    _positive("--fps", config.fps)
    _at_least(1, "--step", config.step)
    _at_least(0, "--first-frame", config.first_frame)
    _at_least(0, "--border-paint-m", config.border_paint_m)
    _at_least(0, "--seed", config.seed)
    if config.frames is not None:
        _at_least(1, "--frames", config.frames)
    if config.height_m is not None:
        _positive("--height-m", config.height_m)
    if config.template_vertices is not None:
        _at_least(4, "--template-vertices", config.template_vertices)
    _check_scanner(config.scanner)


def _check_scanner(config: ScannerConfig) -> None:
    _positive("--scanner.fusion.garment-voxel-m", config.fusion.garment_voxel_m)
    _positive("--scanner.fusion.body-voxel-m", config.fusion.body_voxel_m)
    _positive("--scanner.fusion.truncation-voxels", config.fusion.truncation_voxels)
    _at_least(1, "--scanner.fusion.block-resolution", config.fusion.block_resolution)
    if config.sensor == "stereo":
        _at_least(FEWEST_CAMERAS, "--scanner.stereo.pods", config.stereo.pods)
        _at_least(1, "--scanner.stereo.image-size", config.stereo.image_size)
        _at_least(1, "--scanner.stereo.supersampling", config.stereo.supersampling)
        _positive("--scanner.stereo.baseline-m", config.stereo.baseline_m)
        _angle("--scanner.stereo.field-of-view-deg", config.stereo.field_of_view_deg)
    else:
        _at_least(FEWEST_CAMERAS, "--scanner.rig.cameras", config.rig.cameras)
        _at_least(1, "--scanner.rig.image-size", config.rig.image_size)
        _angle("--scanner.rig.field-of-view-deg", config.rig.field_of_view_deg)


def _at_least(least: int, option: str, value: float) -> None:
    if not value >= least:
        raise InputError(f"{option}: expected at least {least}, found {value:g}")


def _positive(option: str, value: float) -> None:
    if not 0 < value < float("inf"):
        raise InputError(f"{option}: expected a positive number, found {value:g}")


def _angle(option: str, degrees: float) -> None:
    if not 0 < degrees < 180:
        raise InputError(f"{option}: expected an angle between 0 and 180 degrees, found {degrees:g}")
