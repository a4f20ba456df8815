"""Drapes: a garment of one style on one person, at rest in a pose.

A drape is a function of style, shape and pose alone. From the dressing pose the cloth is carried to the pose by its own
skin weights, a part of the way at a time, and then settles until it hardly moves; the way is always the same, so that
drapes need no order, and two processes make the same bytes as one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.body.binding import bind, diffuse, loose_weights, weights_around
from capture4d.body.skinning import PosedBody, ShapedBody, blend_transforms, skin, unskin, with_pose, with_shape
from capture4d.geometry.mesh import face_areas
from capture4d.types import Body
from data_synth.cloth.panels import Pattern
from data_synth.cloth.patterns import PanelMesh, grade
from data_synth.drapes.collision import BodyParts, Wearing
from data_synth.drapes.config import CLOTHS, HOLDS, STYLES, DrapesConfig, Hold, SolverConfig
from data_synth.drapes.dressing import base_garment, hung, mirrored
from data_synth.drapes.garments import GARMENTS, PINNED_M, Garment, panel_vertices, parse_style
from data_synth.drapes.solver import FRAME_SUBSTEPS, SUBSTEP_S, Planes, Sheet, advance, keep_lengths, push_out

__all__ = ["Drape", "Draper", "part_contacts", "symmetric_person"]

CLOSING_FRAMES, CLOSING_KEEP = 60, 0.95
"""In which panels hung around the body come to lie on it, and the share of the velocity that a substep leaves then."""
OUT_MARGINS = (0.5, 0.15)
"""Shares of the margin to which vertices are pushed out of the body at the end, in the first turn and in the last; in
turn with lengths and areas kept, so that what the one undoes of the other gets less."""
OUT_TURNS, EXACT_TURNS, OUT_M = 24, 8, 0.003
"""Number of those turns, the nearest skin is looked for everywhere in every so many, and how far a vertex is pushed in
one, metres: pushed out all at once, what is pinched between belly and thigh makes slivers of the faces around it."""
OUT_AREAS = (0.3, 1.8)
"""Shares of its area within which a face stays when the rest is pushed out after the last turn."""
AROUND_FRAMES = 8
"""Sixtieths of a second after which all of the body is looked at again: what slides off one skin may be in another."""
SWINGING_KEEP = 0.994
"""Share of the velocity that a substep leaves to what is pinned: a pendulum of half a metre is damped critically, and
with less left it creeps."""
SWINGING_TIMES = 3
"""As many times the frames are given to what is pinned: a blade that slides over the trunk comes to rest as slowly with
any damping, by a half in 40 frames."""
WEIGHT_SMOOTHING = 20
"""Further diffusion steps on skin weights: places that bend over a wider stretch do not crumple what they hold."""
OFFSET_SMOOTHING = 12
"""Diffusion steps on how the cloth moves to another person's body."""


@dataclass(frozen=True, slots=True, eq=False)
class Drape:
    """A garment at rest."""

    vertices: np.ndarray
    """(V, 3) float64 metres, the root joint where the rest pose has it."""
    frames: int
    """Sixtieths of a second that it took."""
    motion_mm: float
    """Mean motion in the last of them."""


@dataclass(frozen=True, slots=True, eq=False)
class _Worn:
    """A garment on the person in the dressing pose: where every drape begins."""

    vertices: np.ndarray
    skin_weights: np.ndarray
    rest: np.ndarray
    """(V, 3) unposed; it is held there."""
    start: np.ndarray
    """Body vertex under each contact."""
    gain: np.ndarray
    """(V,) share of the way there that a substep pulls it."""


class Draper:
    """Drapes one garment on one person in any pose.

    Args:
        config: which garment, style and person; samples and poses play no part.
    """

    def __init__(self, config: DrapesConfig, body: Body) -> None:
        kind, mean = GARMENTS[config.garment], symmetric_person(with_shape(body, np.zeros(0)))
        self.config, self.style = config, parse_style(config.garment, config.style)
        base = base_garment(config.garment, mean, config.vertices, config.garment_seed)
        wearer = symmetric_person(with_shape(body, np.array(config.beta))) if any(config.beta) else mean
        to_measure = config.drafted_for == "wearer"
        graded = kind.draft(wearer if to_measure else mean, self.style)
        self.pattern: Pattern = graded
        self.mesh: PanelMesh = grade(base.mesh, base.pattern, graded)
        self.person: ShapedBody = mean
        own = _Fitting(self, kind, base.mesh, mean)
        worn = own.put_on(base.hung)
        if self.style != STYLES[config.garment]() and not (to_measure and any(config.beta)):
            own = _Fitting(self, kind, self.mesh, mean)
            # What is pinned stays as wide as it is hung: a necktie of another width is hung anew.
            start = hung(config.garment, self.mesh, graded, own.body) if kind.pinned else worn.vertices
            worn = own.put_on(start)
        if any(config.beta):
            self.person = wearer
            moved = _moved(worn, self.mesh, mean, self.person)
            own = _Fitting(self, kind, self.mesh, self.person)
            moved = skin(moved, worn.skin_weights, own.body.transforms)
            anew = kind.pinned and to_measure
            worn = own.put_on(hung(config.garment, self.mesh, graded, own.body) if anew else moved)
        self._fitting, self._worn = own, worn

    @property
    def sheet(self) -> Sheet:
        return self._fitting.sheet

    @property
    def part_masks(self) -> np.ndarray:
        """(P, B) which vertices of the body are in each part that the garment meets."""
        return self._fitting.part_masks

    @property
    def contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices of the garment and the part of the body each meets, both (C,)."""
        return self._fitting.contacts

    @property
    def skin_weights(self) -> np.ndarray:
        return self._worn.skin_weights

    @property
    def rest(self) -> np.ndarray:
        """(V, 3) the garment as it was put on, in the rest pose."""
        return self._worn.rest

    @property
    def dressing(self) -> np.ndarray:
        """Joint rotations, (J, 3, 3), in which it was put on."""
        return self._fitting.body.rotations

    @property
    def dressed(self) -> np.ndarray:
        """(V, 3) the garment at rest in the dressing pose."""
        return self._worn.vertices

    def drape(self, rotations: np.ndarray, *, start: tuple[np.ndarray, np.ndarray] | None = None) -> Drape:
        """The garment at rest in a pose.

        Args:
            rotations: (J, 3, 3), the root's and its place left as they are.
            start: vertices, (V, 3), and pose of another drape to come from, instead of the dressing pose; for measuring
                how much a drape owes to its way.
        """
        solver, fitting, worn = self.config.solver, self._fitting, self._worn
        positions, first = (worn.vertices, self.dressing) if start is None else start
        positions, velocities = positions.copy(), np.zeros_like(positions)
        wearing = Wearing(fitting.parts, fitting.contacts, worn.start)
        turns = Rotation.from_matrix(np.einsum("jba,jbc->jac", first, rotations)).as_rotvec()
        before = with_pose(self.person, first, np.zeros(3))
        for part in range(1, solver.way + 1):
            between = np.einsum("jab,jbc->jac", first, Rotation.from_rotvec(turns * part / solver.way).as_matrix())
            body = with_pose(self.person, between, np.zeros(3))
            positions = _carried(positions, worn.skin_weights, before, body)
            before = body
            fitting.settle(wearing, worn, body, positions, velocities, substeps=solver.way_substeps)
        return fitting.come_to_rest(wearing, worn, before, positions, velocities)


class _Fitting:
    """A garment's cloth and one person's body, and how the one comes to rest on the other."""

    def __init__(self, draper: Draper, kind: Garment, mesh: PanelMesh, person: ShapedBody) -> None:
        config = draper.config
        self.solver: SolverConfig = config.solver
        self.hold: Hold = HOLDS[config.garment]
        self.kind, self.mesh, self.person = kind, mesh, person
        self.root_weights = config.garment == "skirt" and config.skirt_weights == "root"
        self.by_distance = config.garment == "skirt" and config.skirt_weights == "distance"
        panels, draft = panel_vertices(mesh, draper.pattern)
        top = draft[:, 1] > draft[:, 1].max() - PINNED_M
        self.pinned = np.flatnonzero(top) if kind.pinned else np.zeros(0, int)
        self.sheet = Sheet.create(mesh, CLOTHS[config.garment], self.pinned)
        self.part_masks = kind.parts(person)
        self.parts = BodyParts.create(person, self.part_masks)
        self.contacts = part_contacts(mesh, panels, kind)
        self.body = with_pose(person, kind.dressing(person), np.zeros(3))

    def put_on(self, points: np.ndarray) -> _Worn:
        """The garment at rest in the dressing pose, the same on both sides, from where it is about."""
        surface = self.parts.posed(self.body)
        start = Wearing.begin(self.parts, self.contacts, points, surface)
        wearing = Wearing(self.parts, self.contacts, start)
        planes = wearing.look_up(points, surface)
        points = points.copy()
        push_out(points, planes, margin=self.solver.margin_m)
        worn = self._held(points, start)
        if self.kind.hang is not None:
            velocities = np.zeros_like(points)
            self.settle(
                wearing, worn, self.body, points, velocities,
                substeps=CLOSING_FRAMES * FRAME_SUBSTEPS, keep=CLOSING_KEEP,
            )  # fmt: skip
        else:
            worn = replace(worn, gain=np.zeros(len(points)))
        points = self.come_to_rest(wearing, worn, self.body, points, np.zeros_like(points)).vertices
        points = (points + mirrored(points, self.mesh)) / 2
        start = Wearing.begin(self.parts, self.contacts, points, surface)
        worn = self._held(points, start)
        wearing = Wearing(self.parts, self.contacts, start)
        velocities = np.zeros_like(points)
        rest = self.come_to_rest(wearing, worn, self.body, points, velocities).vertices
        return replace(worn, vertices=(rest + mirrored(rest, self.mesh)) / 2)

    def settle(
        self,
        wearing: Wearing,
        worn: _Worn,
        body: PosedBody,
        positions: np.ndarray,
        velocities: np.ndarray,
        *,
        substeps: int,
        keep: float | None = None,
    ) -> None:
        """Move positions and velocities, both (V, 3) and changed in place, on a body that is still."""
        surface = self.parts.posed(body)
        hold = skin(worn.rest, worn.skin_weights, body.transforms), worn.gain
        keep, step = self.solver.keep if keep is None else keep, self.solver.contact_substeps
        for done in range(0, substeps, step):
            planes = wearing.look_up(positions, surface)
            advance(
                self.sheet, positions, velocities, hold, planes,
                margin=self.solver.margin_m, keep=keep, substeps=min(step, substeps - done),
            )  # fmt: skip

    def come_to_rest(
        self, wearing: Wearing, worn: _Worn, body: PosedBody, positions: np.ndarray, velocities: np.ndarray
    ) -> Drape:
        """Settle until the mean motion is small; then push out what the last half planes let in."""
        surface = self.parts.posed(body)
        hold = skin(worn.rest, worn.skin_weights, body.transforms), worn.gain
        solver, motion = self.solver, np.inf
        keeps = SWINGING_KEEP if self.kind.pinned else solver.keep
        frames, most = 0, solver.frames * (SWINGING_TIMES if self.kind.pinned else 1)
        calm_after = most if self.kind.pinned else solver.calm_after_frames
        while motion >= solver.still_mm and frames < most:
            before = positions.copy()
            keep = keeps - (1 - keeps) * max(0, frames - calm_after)
            if frames % AROUND_FRAMES == 0:
                wearing.begin_again(positions, surface)
            for _ in range(0, FRAME_SUBSTEPS, solver.contact_substeps):
                planes = wearing.look_up(positions, surface)
                advance(
                    self.sheet, positions, velocities, hold, planes,
                    margin=solver.margin_m, keep=keep, substeps=solver.contact_substeps,
                )  # fmt: skip
            motion = 1e3 * float(np.linalg.norm(positions - before, axis=1).mean())
            frames += 1
        wearing.begin_again(positions, surface)
        for turn, share in enumerate(np.linspace(*OUT_MARGINS, OUT_TURNS), start=1):
            keep_lengths(self.sheet, positions)
            planes = (wearing.look_up if turn % EXACT_TURNS else wearing.look_up_exactly)(positions, surface)
            push_out(positions, planes, margin=share * solver.margin_m, farthest=OUT_M)
        self._push_the_rest_out(positions, planes)
        return Drape(positions, frames, motion)

    def _push_the_rest_out(self, positions: np.ndarray, planes: Planes) -> None:
        """All the way, (V, 3) changed in place, but for corners of faces that would not bear it."""
        pushed, left = positions.copy(), np.zeros(len(positions), bool)
        push_out(pushed, planes, margin=OUT_MARGINS[1] * self.solver.margin_m)
        while True:
            ratios = face_areas(pushed, self.sheet.faces) / self.sheet.areas
            corners = self.sheet.faces[(ratios < OUT_AREAS[0]) | (ratios > OUT_AREAS[1])].ravel()
            if left[corners].all():
                break
            left[corners] = True
            pushed[left] = positions[left]
        positions[:] = pushed

    def _held(self, points: np.ndarray, start: np.ndarray) -> _Worn:
        """The garment as it is now in the dressing pose, and how it is held there."""
        weights = self._weights(points)
        rest, flagged = unskin(points, weights, self.body.transforms)
        assert not flagged.any(), "the dressing pose cannot be unposed"
        hold = self.hold
        below = np.maximum(self.kind.held_from(self.person, rest, self.mesh) - rest[:, 1], 0) / hold.depth_m
        share = hold.floor + (1 - hold.floor) * np.exp(-(below**2))
        pull = (2 * np.pi * hold.hz * SUBSTEP_S) ** 2 * share
        gain = pull / (1 + pull)
        gain[self.pinned] = 1.0
        return _Worn(points, weights, rest, start, gain)

    def _weights(self, points: np.ndarray) -> np.ndarray:
        """Skin weights of the garment, (V, J), the same on both sides."""
        skin_weights = self.person.body.skin_weights
        if self.root_weights:
            return loose_weights(points, self.body, follow="root")
        if self.by_distance:
            legs = np.flatnonzero(self.part_masks.any(axis=0))
            weights = weights_around(points, self.body.vertices()[legs], skin_weights[legs])
        else:
            weights = diffuse(bind(points, self.mesh.faces, self.body)[2], self.mesh.faces, WEIGHT_SMOOTHING)
        assert self.mesh.mirror is not None
        weights = weights + weights[self.mesh.mirror][:, _other_side(self.person.body.joint_names)]
        return weights / weights.sum(axis=1, keepdims=True)


def symmetric_person(person: ShapedBody) -> ShapedBody:
    """The same person with a left side that is the right one mirrored; shapes differ by hundredths of a millimetre.

    A body whose mesh is not symmetric is returned as it is.
    """
    template, flip = person.body.template.vertices, np.array([-1.0, 1.0, 1.0])
    distance, image = map(np.asarray, KDTree(template).query(template * flip))
    joints = _other_side(person.body.joint_names)
    if distance.max() > 1e-3 or len(np.unique(image)) < len(image):
        return person
    return replace(
        person,
        vertices=(person.vertices + person.vertices[image] * flip) / 2,
        joints=(person.joints + person.joints[joints] * flip) / 2,
    )


def _other_side(names: tuple[str, ...]) -> np.ndarray:
    """(J,) the joint on the body's other side."""
    swap = {".L": ".R", ".R": ".L"}
    return np.array(
        [names.index(name[:-2] + swap[name[-2:]]) if name[-2:] in swap else i for i, name in enumerate(names)]
    )


def part_contacts(mesh: PanelMesh, panels: np.ndarray, kind: Garment) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and the part of the body each meets, (C,) int32.

    It is one part for each: cloth that two parts squeeze between them is pushed from one into the other and back, and
    ends as crushed and overstretched faces.
    """
    parts = max(part for met in (*kind.meets.values(), (kind.seam,)) for part in met) + 1
    meets = np.zeros((mesh.vertex_count, parts), bool)
    for face_panel in np.unique(mesh.face_panels):
        corners = np.unique(mesh.faces[mesh.face_panels == face_panel])
        name = panels[np.flatnonzero(mesh.face_panels[mesh.vertex_faces] == face_panel)[0]]
        own = np.zeros(parts, bool)
        own[list(kind.meets[str(name)])] = True
        sewn = corners[(meets[corners] & ~own).any(axis=1)]  # to a panel that meets another part
        meets[corners] |= own
        meets[sewn] = np.arange(parts) == kind.seam
    vertices, met = np.nonzero(meets)
    return vertices.astype(np.int32), met.astype(np.int32)


def _carried(points: np.ndarray, skin_weights: np.ndarray, start: PosedBody, end: PosedBody) -> np.ndarray:
    """A garment, (V, 3), carried by its skin weights from one pose to another."""
    here, there = (blend_transforms(skin_weights, body.transforms) for body in (start, end))
    rest = np.linalg.solve(here[:, :, :3], (points - here[:, :, 3])[..., None])[..., 0]
    return np.einsum("vab,vb->va", there[:, :, :3], rest) + there[:, :, 3]


def _moved(worn: _Worn, mesh: PanelMesh, before: ShapedBody, after: ShapedBody) -> np.ndarray:
    """The garment at rest, (V, 3), moved with the skin under it from one person onto another."""
    identity = np.repeat(np.eye(3)[None], len(before.joints), axis=0)
    faces, barycentric, _ = bind(worn.rest, mesh.faces, with_pose(before, identity, np.zeros(3)))
    change = (after.vertices - before.vertices)[before.body.template.faces[faces]]
    return worn.rest + diffuse(np.einsum("vk,vkx->vx", barycentric, change), mesh.faces, OFFSET_SMOOTHING)
