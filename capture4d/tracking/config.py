"""Settings of body tracking, split by role. Standard library only: the command line imports this to print its help."""

from __future__ import annotations

from dataclasses import field

from capture4d.captures.points.sampling import SamplingConfig
from capture4d.settings import Cosine, Count, NonNegative, Positive, Share, Whole, settings

__all__ = ["ColdStartConfig", "FitConfig", "Schedule", "SequenceConfig", "TrackingConfig"]


@settings
class Schedule:
    """The course of one fit."""

    iterations: Count = 4
    """Gauss-Newton steps at most."""
    first_scale_m: Positive = 0.05
    """Distance at which a point has lost most of its weight, at first, ..."""
    last_scale_m: Positive = 0.015
    """... and in the end."""
    stop_m: NonNegative = 1e-4
    """The fit is done once no step that looks at all points moves anything farther than this."""


@settings
class FitConfig:
    """Weights of the terms. Figures from `python -m benchmarks tracking`, on other settings of the same takes."""

    point_sigma_m: Positive = 0.008
    """Error of one point: noise, and what the body model cannot follow. Neighbouring points err alike, so it is larger
    than the noise."""
    mismatch: NonNegative = 0.25
    """Error of a match, as a share of the distance at which points lose their weight: wide searches trust them less."""
    turn_step: Positive = 0.3
    """Levenberg damping: the turn, radians (or metres), of one step that costs as much as one standard deviation."""
    shape_step: Positive = 1.0
    """The same for shape coefficients."""
    cloth_gap_m: NonNegative = 0.004
    """Distance that cloth keeps from skin where it touches."""
    cloth_pull: NonNegative = 0.02
    """Weight of cloth points outside the body, against 1 inside: where cloth nearly touches it shows the body."""
    cloth_pull_reach_m: Positive = 0.008
    """Distance at which that weight is gone."""
    normal_cosine: Cosine = 0.3
    """Points whose normal differs more from the body's are left out."""
    limit_softness_deg: Positive = 4.0
    """Overshoot of a joint limit that weighs as much as one standard deviation."""
    shape_spread: Positive = 1.0
    """Standard deviation of the shape coefficients before any scan."""
    few_points: Count = 1500
    """Points of a scan that the first steps of a fit look at: the last three, to which they only lead, look at all."""


@settings
class ColdStartConfig:
    """The search for the first pose."""

    facings: Count = 8
    """Directions, all round, that the subject may face."""
    points: Count = 700
    """Points of the scan that the search reads."""
    survivors: Count = 6
    """Starts that are followed up with other poses of legs and arms."""
    finalists: Count = 4
    """Starts that are fitted in full."""
    second_round_m: NonNegative = 0.012
    """Misfit of the winner beyond which its limbs are tried again: 11 mm at most where all is right."""
    shape_spread: Positive = 0.15
    """Standard deviation of the shape coefficients while the search is on."""
    rough: Schedule = Schedule(iterations=12, first_scale_m=0.25, last_scale_m=0.06)
    """Of every start."""
    limbs: Schedule = Schedule(iterations=8, first_scale_m=0.12, last_scale_m=0.04)
    """Of every pose of a limb tried on a survivor."""
    settle: Schedule = Schedule(iterations=15, first_scale_m=0.15, last_scale_m=0.03)
    """Of the finalists on all points, their shape still held back, ..."""
    full: Schedule = Schedule(iterations=25, first_scale_m=0.08, last_scale_m=0.015)
    """... and in full."""


@settings
class SequenceConfig:
    """From frame to frame."""

    segment: Count = 240
    """Frames of a segment. Segments are followed side by side, on as many processes and machines as there are."""
    overlap: Whole = 24
    """Frames before its first one from which a segment is followed, beginning with a search."""
    seam_mm: NonNegative = 10.0
    """How far a segment may put a frame from where the one before has it, mean over the joints; if it is farther, it is
    followed anew from that one's end."""
    follow: Schedule = Schedule(iterations=4, first_scale_m=0.05, last_scale_m=0.015)
    """Of a frame that starts from the one before."""
    retry: Schedule = Schedule(iterations=15, first_scale_m=0.12, last_scale_m=0.015)
    """Of a frame that this did not fit."""
    refine: Schedule = Schedule(iterations=3, first_scale_m=0.02, last_scale_m=0.015)
    """Of the second pass, with the one shape of the take."""
    momentum: Share = 0.9
    """Share of the last motion that is expected to go on."""
    motion_spread: Positive = 0.2
    """Standard deviation of a joint's turn from what is expected, radians a frame."""
    acceleration: Positive = 10.0
    """How fast the turning of a joint changes, radians a second squared: the second pass draws a frame so much towards
    the mean of its neighbours."""
    shape_memory: Share = 0.99
    """Share of what is known about the shape that is kept from frame to frame."""
    search_every: Count = 15
    """Lost frames between two searches for the pose."""
    explained_m: Positive = 0.012
    """A point of skin or suit is explained by the body if it is this near."""
    check_explained: Share = 0.85
    """Frames with a smaller share of explained points are flagged."""
    check_median_m: NonNegative = 0.0025
    """Frames whose median distance on skin and suit is larger are flagged: a body that faces backwards can lie within
    12 mm of most points, but not this close. Raise it for scans noisier than that."""
    outlier_median: NonNegative = 2.0
    """Frames are flagged as well if that distance is so many times what is usual in the take, ..."""
    least_outlier_m: NonNegative = 0.001
    """... and larger than this."""
    check_far: Share = 0.03
    """Frames with a larger share of skin and suit farther than `far_m` from the body, or facing elsewhere, are flagged:
    a whole arm is 4 to 6 %."""
    far_m: NonNegative = 0.05
    """Distance of a point that belongs to another part of the body."""
    fail_explained: Share = 0.6
    """Frames with a smaller share are lost: nothing is built upon them."""
    largest_shape: NonNegative = 3.5
    """Frames that need a shape coefficient beyond this are flagged: the pose is wrong, or the body."""
    least_points: Count = 150
    """Frames with fewer points on skin and suit are lost as well."""


@settings
class TrackingConfig:
    """Everything that decides a take's poses."""

    start: str = "search"
    """Where the first frame starts: `search` for the pose, the `rest` pose, or a motion file that holds it."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    cold_start: ColdStartConfig = field(default_factory=ColdStartConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
