"""Settings of the garment model. No heavy imports, so that the command line can list them at once."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from capture4d.captures.animations.config import RemovalConfig
from capture4d.settings import (
    Count,
    NonNegative,
    NotEmpty,
    Part,
    Positive,
    Range,
    Seed,
    SettingError,
    Share,
    Whole,
    settings,
)


@settings
class ShapeConfig:
    """The statistical model: mean and principal directions of the unposed garment."""

    components: Whole = 0
    """How many directions to keep; 0: the fewest with which no vertex of a training frame is off by more than
    `max_error_mm`."""
    max_error_mm: NonNegative = 5.0
    """Worst vertex of the worst training frame, in the pose (the paper's 5 mm at 500 directions)."""
    most_components: Count = 500
    """No more than so many, whatever the error."""
    method: Literal["auto", "exact", "randomised"] = "auto"
    """How directions are found; `auto` is exact up to `memory_mb`."""
    memory_mb: NonNegative = 1500.0
    """Larger takes are read block by block."""
    unseen_weight: Share = 0.05
    """Weight of a vertex without scan data, beside 1 for one with: registration guessed it."""
    filling_rounds: Whole = 6
    """How often unseen vertices are filled in from the model and the model learned again."""


@settings
class SplitConfig:
    """Which clips are learned from, and which decide. Clips are never cut between neighbouring frames."""

    validation: tuple[str, ...] = ()
    """Takes to validate on, by the name of their work folder; chosen at random if absent."""
    held_out: tuple[str, ...] = ()
    """Takes that learning never sees."""
    validation_share: Part = 0.15
    """Part of the frames to validate on."""
    gap_s: NonNegative = 0.5
    """Seconds left out on both sides of a cut, where one take has to be cut because it is the only one."""
    seed: Seed = 0
    """Of the choice of takes to validate on."""


@settings
class ControlConfig:
    """What drives the garment: by default the paper's control vector."""

    joint_share: Share = 0.004
    """A joint belongs to the garment if it carries this share of its skin weights."""
    root_motion: bool = True
    """Velocity and acceleration of the root, in the root's frame."""
    derivative_frames: Annotated[int, Range(least=3)] = 5
    """Frames, the present one and those before, through which a parabola is laid for them; 3 are plain differences,
    more are less noisy."""
    up: bool = False
    """The direction of gravity in the root's frame as well."""
    joint_velocity: bool = False
    """Angular velocities of the garment's joints and of the root as well."""
    whole_rotations: bool = False
    """How the garment's joints are turned against the root, all joints between taken together, as well."""
    lags: tuple[Count, ...] = ()
    """How far the rotations have come in so many frames as well: cloth that slid up an arm is slow to come down."""
    history: Whole = 0
    """Coefficients of so many frames before, as predicted (the autoregressive variant)."""


@settings
class LinearConfig:
    """Linear regression from control vectors to coefficients."""

    fit: Literal["ridge", "moore-penrose"] = "ridge"
    """Least squares with an intercept, or F = L T^+ as the paper prints it, without."""
    ridges: Annotated[tuple[NonNegative, ...], NotEmpty] = (1e-3, 1e-2, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
    """Penalties to choose from on the validation clips, relative to the variance of a standardised control. Without any
    (0), what the validation clips could not show goes wild in a motion that has it."""


@settings
class KernelTuningConfig:
    """Tuning of the kernels by leaving out each take in turn."""

    enabled: bool = True
    """Off: a control counts by as much as the linear regression says, and all kinds of kernels alike."""
    least_takes: Annotated[int, Range(least=2)] = 3
    """With fewer takes there is nothing to tell by."""
    line: NonNegative = 0.1
    """Weight with which a linear kernel begins, beside 1 of all others. It goes on where no learned frame is near, for
    better or worse, so without tuning there is none."""
    frames: Annotated[int, Range(least=2)] = 600
    """From so many frames, evenly spread; time grows with their cube."""
    rounds: Count = 30
    """Steps of L-BFGS at most."""
    restraint: NonNegative = 0.01
    """Penalty on the squared logarithms of the factors, beside the mean logarithm of the takes' squared errors;
    chosen on takes that were kept even from the tuning."""
    kept: Annotated[float, Range(above=0, most=1)] = 0.995
    """Share of the coefficients' square in the principal directions that are looked at."""


@settings
class KernelConfig:
    """Kernel ridge regression from control vectors to coefficients."""

    control: ControlConfig = field(
        default_factory=lambda: ControlConfig(whole_rotations=True, lags=(6, 18))  # 0.1 and 0.3 s at 60 fps
    )
    """Its own control vector, more than the paper's."""
    length: Positive = 3.0
    """Square of the width of the kernel over everything, relative to the mean squared distance of two frames."""
    side_length: Positive = 1.5
    """The same of the kernels over the sides of the body."""
    ridges: Annotated[tuple[Positive, ...], NotEmpty] = (0.15,)
    """Penalty; a frame's likeness to itself is 1 before tuning, which goes by the first. Of several the validation
    clips choose, badly if they are few."""
    tuning: KernelTuningConfig = field(default_factory=KernelTuningConfig)
    most_frames: Annotated[int, Range(least=2)] = 4000
    """Learn from no more frames than so many, evenly spread: memory grows with their square, time with their cube."""

    def __post_init__(self) -> None:
        if self.control.history:
            raise SettingError(self, "control.history", "0, for kernels carry nothing on", self.control.history)


@settings
class LstmConfig:
    """The sequence-to-sequence network: encoder and decoder of the same size."""

    layers: Count = 1
    """The paper has 4; on a thousand frames they generalise worse than one."""
    size: Count = 256
    """Numbers in the state of a layer."""
    window: Count = 3
    """Frames in and frames out."""
    over_linear: bool = True
    """Learn what the linear regression leaves; off, as in the paper, the whole."""
    weighed: bool = True
    """Give controls the size of what the garment moves with them; off, one size to all of a kind."""


@settings
class TrainingConfig:
    """One training run."""

    epochs: Whole = 0
    """The learning rate falls to zero over them, along a cosine. 0: thirty, or as many as make 500 steps."""
    batch: Count = 128
    """Windows in a step."""
    learning_rate: Positive = 1e-3
    """Of AdamW, at the beginning."""
    weight_decay: NonNegative = 2.0
    """Decoupled from the gradient (AdamW)."""
    control_noise: NonNegative = 0.15
    """Standard deviation of noise on the standardised controls, drawn anew for every window."""
    teacher_forcing: Share = 0.0
    """Probability that a step of the decoder is given the true coefficients of the step before, not its own."""
    loss: Literal["coefficients", "whitened"] = "coefficients"
    """Squared error of the coefficients, as it is measured, or of the whitened ones, in which the last direction counts
    as much as the first."""
    clip_gradient: Positive = 1.0
    """Largest norm of a gradient."""
    patience: Count = 40
    """Epochs without improvement on the validation clips after which to stop."""
    checkpoint_s: NonNegative = 30.0
    """Seconds between checkpoints; they change nothing in the result."""
    threads: Count = 1
    """Threads of torch; results are the same bits only for the same number."""
    seed: Seed = 0
    """Of the first weights, the order of the windows and the noise."""


@settings
class FitConfig:
    """Learning a garment."""

    licence: str = ""
    """A note on who may use the model, kept in its file."""
    regressor: Literal["all", "kernel", "linear"] = "all"
    """`kernel` leaves the LSTM out, `linear` the kernels as well."""
    mirror: Literal["auto", "on", "off"] = "auto"
    """Whether regressors learn from the takes seen in a mirror as well; `auto`: if skeleton and garment have two sides
    that are alike."""
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    linear: LinearConfig = field(default_factory=LinearConfig)
    kernel: KernelConfig = field(default_factory=KernelConfig)
    lstm: LstmConfig = field(default_factory=LstmConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)


@settings
class AnimateConfig:
    """Putting a learned garment on a motion and a body."""

    regressor: Literal["auto", "ensemble", "kernel", "lstm", "linear"] = "auto"
    """`auto`: the one that did best on the frames that validated. `ensemble` is the mean of kernels and LSTM."""
    mean: Literal["corrected", "printed", "captured"] = "corrected"
    """How the mean meets another body: moved by the difference of the two bodies (Eq. 5, corrected), by the new body's
    whole offset from the average person (as printed), or not at all."""
    longest: NonNegative = 1.15
    """Edges are drawn together to this many times their length in the template on the person, or their length in the
    mean garment, if that is more; 0: they stay as long as they come."""
    unlike_deg: NonNegative = 10.0
    """A pose farther than this from every training pose is reported, unless the model was validated farther away."""
    fps: Positive | None = None
    """Frame rate of what is written; the model's if absent. Regressors always answer at the model's, whatever the
    motion's; their coefficients are interpolated."""
    removal: RemovalConfig = field(default_factory=RemovalConfig)
