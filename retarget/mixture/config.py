"""Settings of garments with styles. Standard library only, so that the command line can list them at once."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Annotated, Literal

from capture4d.settings import Count, NonNegative, Part, Positive, Range, Seed, settings

MODEL = "styles.safetensors"
"""A learned garment, in its folder."""

__all__ = [
    "PRESETS",
    "CanonicalConfig",
    "KernelConfig",
    "MixtureConfig",
    "NetworkConfig",
    "SplitConfig",
    "StyleFitConfig",
    "StylesConfig",
]


@settings
class SplitConfig:
    """What counts as smooth."""

    half_m: Positive = 0.2
    """Wavelength of which half is smooth, metres."""
    printed: bool = False
    """80 steps of 0.15, as the paper prints them, whatever the length of the mesh's edges."""


@settings
class NetworkConfig:
    """A network with two hidden layers, and how it learns."""

    hidden: Count = 256
    """Numbers in a layer."""
    dropout: Part = 0.2
    """After the first layer."""
    heads: Literal["basis", "vertices"] = "basis"
    """What it says: coefficients of principal directions that all pairs share, or displacements of every vertex."""
    directions: Count = 256
    """At most so many."""
    loss: Literal["l2", "l1"] = "l2"
    """Squared distance, or the sum of absolute values as in the paper, of what it says."""
    epochs: Count = 300
    """How often every drape is learned from, at most."""
    patience: Count = 100
    """Epochs without a better validation error after which training stops."""
    batch: Count = 32
    """Drapes in a step at most: a small set is learned from in eight steps, unless they would be of fewer than four."""
    learning_rate: Positive = 1e-3
    """Of Adam."""
    falling: bool = True
    """The rate falls to zero along a cosine."""
    weight_decay: NonNegative = 1e-3
    """Decoupled from the gradient (AdamW)."""
    coupled: bool = False
    """Weight decay is part of the gradient, as in plain Adam."""


@settings
class CanonicalConfig:
    """From style and shape to the garment in the A-pose."""

    kind: Literal["kernel", "network"] = "kernel"
    """Kernels over a plane; or a small network, as in the paper."""
    lengths: tuple[Positive, ...] = (0.5, 1.0, 2.0, 4.0)
    """Widths of the kernel to choose from by leaving out each pair in turn; ranges are 2 wide."""
    ridges: tuple[Positive, ...] = (1e-3, 1e-2, 0.1)
    """Penalties to choose from likewise."""
    network: NetworkConfig = field(
        default_factory=lambda: NetworkConfig(
            hidden=128, heads="vertices", loss="l1", epochs=400, patience=400, falling=False, weight_decay=1e-5,
            coupled=True,
        )
    )  # fmt: skip
    """The paper's, if that is what is wanted."""


@settings
class KernelConfig:
    """Kernel ridge regression from pose, style and shape to displacements."""

    length: Positive = 1.0
    """Square of the kernel's width, relative to half the mean squared distance of two drapes."""
    style_weight: NonNegative = 2.0
    """By how much a number of style or shape counts, beside one of the pose."""
    ridge: Positive = 0.05
    """Penalty; a drape's likeness to itself is 1."""


@settings
class MixtureConfig:
    """The paper's mixture: one network for what is smooth, and one for the rest of each prototype."""

    split: SplitConfig = field(default_factory=SplitConfig)
    high: NetworkConfig = field(default_factory=NetworkConfig)
    """Of the network of each prototype."""
    bandwidth: Literal["left-out", "released"] = "left-out"
    """How alike two garments have to be in the A-pose: as wide as foretells each prototype best from the others, or as
    released, which is narrow."""
    normalised: bool = True
    """Weights of the prototypes sum to 1. As printed (Eq. 9) they do not."""


@settings
class StylesConfig:
    """Learning a garment with styles."""

    method: Literal["ensemble", "mixture"] = "ensemble"
    """Networks and kernels together, or the paper's mixture of prototypes."""
    over: Literal["drape", "body"] = "drape"
    """What displacements are learned over: the garment of that style and shape in the A-pose, or, as in the paper, the
    body."""
    members: Annotated[int, Range(least=0, most=16)] = 3
    """Networks of the ensemble."""
    kernels: bool = True
    """Kernels are half of the ensemble."""
    pose: Literal["matrices", "axis-angle"] = "matrices"
    """How a joint's rotation is told: nine numbers, or three."""
    standardised: bool = True
    """Numbers of the pose about their mean, over their deviation."""
    joint_share: NonNegative = 0.004
    """A joint is told if it carries this share of the garment's skin weight, or lies above one that does."""
    validation: Annotated[float, Range(least=0, below=0.9)] = 0.1
    """Share of the learned poses that networks are not shown, but which tell when to stop."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Of the ensemble's networks, or of the mixture's smooth part."""
    kernel: KernelConfig = field(default_factory=KernelConfig)
    canonical: CanonicalConfig = field(default_factory=CanonicalConfig)
    mixture: MixtureConfig = field(default_factory=MixtureConfig)
    checkpoint_every: Count = 50
    """Epochs; they change nothing in the result."""
    seed: Seed = 0
    """Of the first weights, the order of the drapes and what is held back for validation."""


@settings
class StyleFitConfig:
    """Finding the style of a garment that was seen."""

    source: Literal["auto", "registration", "scans"] = "auto"
    """What it is fitted to: registered frames or, as `auto` does where nothing is registered, the scans' garments."""
    frames: str | None = None
    """Only these frames of the take, such as 1,5,10-20; as many as `count` if absent."""
    count: Count = 4
    """Frames, evenly over the take, that share one style."""
    pose: bool = True
    """Turn the joints that move the garment a little from the tracked pose, if that explains more."""


_RELEASED = NetworkConfig(
    hidden=1024, heads="vertices", loss="l1", epochs=100, patience=100, learning_rate=1e-4, falling=False,
    weight_decay=1e-6, coupled=True,
)  # fmt: skip
"""Hidden size, dropout, rate, decay and epochs as in the released code; the best epoch is kept."""

PRESETS: dict[str, StylesConfig] = {
    "default": StylesConfig(),
    "paper": StylesConfig(
        method="mixture",
        over="body",
        pose="axis-angle",
        standardised=False,
        network=_RELEASED,
        canonical=CanonicalConfig(kind="network"),
        mixture=MixtureConfig(
            SplitConfig(printed=True), replace(_RELEASED, epochs=800, patience=800), bandwidth="released"
        ),
    ),
}
"""`paper` is the recipe of TailorNet, with what only the released code says."""
