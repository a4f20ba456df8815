"""A learned garment with styles: pose, shape and style in, vertices out.

    garment = load_styled_garment(Path("model"))
    garment.vertices(poses, beta=(1.0, -0.5), style={"length": 0.7})

References: TailorNet (CVPR 2020), equations 3, 4 and 8.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32
from torch import nn

from capture4d.body.body_candidates import BodyCandidates
from capture4d.body.limbs import WornBody
from capture4d.body.skinning import PosedBody, ShapedBody, skin, with_pose, with_shape
from capture4d.captures.animations.known_poses import PoseRange
from capture4d.captures.drapes.style_sets import Ranges
from capture4d.errors import InputError
from capture4d.geometry.intersection_removal import IntersectionRemoval, Removed
from capture4d.geometry.mesh import edge_lengths, unique_edges
from capture4d.types import Body, Garment, PoseSequence
from retarget.config import AnimateConfig
from retarget.mixture.heads import PoseNumbers
from retarget.mixture.kernel_ridge import KernelRidge
from retarget.mixture.lesson import person_under
from retarget.mixture.predictors import Predictor
from retarget.mixture.training import said_by

__all__ = ["Canonical", "StyledGarment", "WornGarment"]


@dataclass(frozen=True, slots=True, eq=False)
class Canonical:
    """g: from style and shape to displacements in the A-pose."""

    regression: KernelRidge | nn.Sequential
    mean: Float64[np.ndarray, "verts 3"]
    """What the regression is about, metres."""

    def __call__(self, numbers: Float64[np.ndarray, " numbers"]) -> Float64[np.ndarray, "verts 3"]:
        """Metres."""
        if isinstance(self.regression, KernelRidge):
            flat = self.regression.predict(numbers[None])[0]
        else:
            flat = said_by(self.regression, numbers[None].astype(np.float32))[0].astype(np.float64)
        return self.mean + flat.reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class StyledGarment:
    """A garment in every style, on everybody, in every pose: as far as its drapes reach."""

    garment: Garment
    body: Body
    ranges: Ranges
    """Of styles and shapes that it was learned from."""
    pose: PoseNumbers
    canonical: Canonical
    predictor: Predictor
    over_drape: bool
    """Displacements are over the garment in the A-pose, not over the body."""
    learned: PoseRange
    """The poses that it was learned from."""

    def vertices(
        self,
        pose: PoseSequence,
        beta: Sequence[float] | Float[np.ndarray, " betas"] = (),
        style: Mapping[str, float] | Sequence[float] | None = None,
        *,
        remove_intersections: bool = True,
    ) -> Float32[np.ndarray, "frames verts 3"]:
        """The garment of a style on a person, metres, world, a row for each pose.

        A pose alone decides: what went before it plays no part. The root turns the garment as a whole.

        Args:
            beta: shape coefficients of the person, of which the last may be left out.
            style: numbers of the style, by name, or in the order of `ranges`; in the middle of their range if left out.
            remove_intersections: move what is inside the body out of it.
        Raises:
            InputError: the poses are of another skeleton, or style or shape are outside what was learned.
        """
        if pose.joint_names != self.body.joint_names:
            raise InputError(
                f"pose: expected the {len(self.body.joint_names)} joints of the model, found {len(pose.joint_names)} "
                f"({', '.join(pose.joint_names[:4])}, ...)"
            )
        frames = zip(pose.rotations, pose.translations, strict=True)
        found = [*self.worn(beta, style).frames(frames, remove_intersections=remove_intersections)]
        return np.stack(found) if found else np.zeros((0, len(self.garment.template.vertices), 3), np.float32)

    def worn(
        self,
        beta: Sequence[float] | Float[np.ndarray, " betas"] = (),
        style: Mapping[str, float] | Sequence[float] | None = None,
        config: AnimateConfig | None = None,
    ) -> WornGarment:
        """The garment of a style on a person, with everything computed once that frames share.

        Args:
            config: how cloth is taken out of the body (`removal`) and its edges kept (`longest`).
        Raises:
            InputError: style or shape are outside what was learned.
        """
        if style is not None and not isinstance(style, Mapping):
            style = self.ranges.named(style)
        unknown = [name for name in style or {} if name not in self.ranges.style]
        if unknown:
            raise InputError(f"style: expected {', '.join(self.ranges.style)}, found '{unknown[0]}'")
        numbers = self.ranges.numbers(style or {}, beta)
        person = with_shape(self.body, np.asarray(beta, np.float64))
        return WornGarment(self, numbers, person, config or AnimateConfig())


class WornGarment:
    """A style on a person, in any pose.

    Args:
        numbers: style and shape, from -1 to 1.
    """

    def __init__(
        self,
        garment: StyledGarment,
        numbers: Float64[np.ndarray, " numbers"],
        person: ShapedBody,
        config: AnimateConfig,
    ) -> None:
        self.person = person
        self._garment, self._numbers, self._config = garment, numbers, config
        self._under = person_under(garment.garment, garment.body, np.asarray(person.shape, np.float32))
        self._canonical = garment.canonical(numbers)
        self._contact: tuple[IntersectionRemoval, WornBody] | None = None
        self._near: BodyCandidates | None = None

    @property
    def under(self) -> Float64[np.ndarray, "verts 3"]:
        """The points of the body that the garment is bound to, in the A-pose, metres."""
        return self._under

    @property
    def canonical(self) -> Float64[np.ndarray, "verts 3"]:
        """Displacements of this style on this person in the A-pose, metres."""
        return self._canonical

    @property
    def in_a_pose(self) -> Float64[np.ndarray, "verts 3"]:
        """The garment at rest in the A-pose, which is the body's rest pose, metres."""
        return self._under + self._canonical

    @property
    def faces(self) -> Int32[np.ndarray, "faces 3"]:
        return self._garment.garment.template.faces

    def unposed(self, rotations: Float[np.ndarray, "frames joints 3 3"]) -> Float64[np.ndarray, "frames verts 3"]:
        """The garment in some poses, as it is without them, metres."""
        garment, joints = self._garment, len(self._garment.body.joint_names)
        if rotations.shape[1:] != (joints, 3, 3):
            raise InputError(f"rotations: expected those of {joints} joints, found {rotations.shape[1:]}")
        said = garment.predictor.displacements(garment.pose.of(rotations), self._numbers, self._canonical)
        return (self.in_a_pose if garment.over_drape else self._under) + said

    def frames(
        self,
        poses: Iterable[tuple[Float[np.ndarray, "joints 3 3"], Float[np.ndarray, "3"]]],
        *,
        remove_intersections: bool = True,
    ) -> Iterator[Float32[np.ndarray, "verts 3"]]:
        """The garment in one pose after the other, as they come, metres; rotations and the root's translation."""
        for rotations, translation in poses:
            if remove_intersections:
                vertices = self.outside(rotations, translation).vertices
            else:
                vertices = self._placed(with_pose(self.person, rotations, translation))
            yield vertices.astype(np.float32)

    def outside(self, rotations: Float[np.ndarray, "joints 3 3"], translation: Float[np.ndarray, "3"]) -> Removed:
        """The garment in a pose, out of the body, and how it came out."""
        body = with_pose(self.person, rotations, translation)
        removal, worn = self._contacts()
        return removal(self._placed(body), worn.posed(body.vertices()))

    def live(
        self, rotations: Float[np.ndarray, "joints 3 3"], translation: Float[np.ndarray, "3"]
    ) -> Float64[np.ndarray, "verts 3"]:
        """The garment in a pose, metres, as fast as a picture is drawn.

        It is pushed out of the limbs that carry it, which leaves a few tenths of a percent inside; `outside` leaves
        next to nothing and takes about ten times as long.
        """
        if self._near is None:
            garment, config = self._garment.garment, self._config
            assert garment.skin_weights is not None
            self._near = BodyCandidates(
                self.person, self.in_a_pose, self.faces, garment.skin_weights,
                longest=config.longest or np.inf, margin_m=1e-3 * config.removal.margin_mm,
            )  # fmt: skip
        body = with_pose(self.person, rotations, translation)
        return self._near.pushed_out(self._near.skinned(self.unposed(np.asarray(rotations)[None])[0], body), body)

    def _placed(self, body: PosedBody) -> Float64[np.ndarray, "verts 3"]:
        weights = self._garment.garment.skin_weights
        assert weights is not None
        return skin(self.unposed(np.asarray(body.rotations)[None])[0], weights, body.transforms)

    def _contacts(self) -> tuple[IntersectionRemoval, WornBody]:
        """What takes it out of the body; made when it is first needed."""
        if self._contact is None:
            garment, at_rest, config = self._garment.garment, self.in_a_pose, self._config
            assert garment.skin_weights is not None
            lengths = edge_lengths(at_rest, unique_edges(self.faces))
            longest = config.longest or np.inf
            removal = IntersectionRemoval(self.faces, len(at_rest), lengths, longest, config.removal)
            self._contact = removal, WornBody(self.person, at_rest, garment.skin_weights)
        return self._contact
