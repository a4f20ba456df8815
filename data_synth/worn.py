"""What a synthetic subject wears: how the garment of a take is cut, put on, held, and bound to the body.

Without further words it is a T-shirt. A shirt is put on as one, with straight arms; trousers and skirts are hung around
the body in its rest pose, and held at the waist.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture4d.body.binding import loose_weights
from capture4d.body.skinning import PosedBody, ShapedBody, with_pose
from capture4d.geometry.ray_casting import TriangleScene
from data_synth.cloth.panels import Pattern
from data_synth.cloth.patterns import PanelMesh
from data_synth.cloth.simulation import clear_of_body, dress
from data_synth.cloth.tshirt import tshirt_pattern
from data_synth.config import SynthConfig
from data_synth.drapes.dressing import hung
from data_synth.drapes.garments import GARMENTS, parse_style

__all__ = ["PutOn", "draft", "dressing_pose", "is_held_at_waist", "put_on", "template_weights"]


@dataclass(frozen=True, slots=True, eq=False)
class PutOn:
    """A garment around the body, not yet at rest."""

    vertices: np.ndarray
    """(V, 3) metres, outside of the body, in the first frame of the take."""
    held_from: float | None
    """Height in the rest pose below which it is held less, metres; None: that of the shoulders."""


def draft(config: SynthConfig, person: ShapedBody) -> Pattern:
    """The pattern of a take's garment for a person.

    Raises:
        InputError: the cut names what this garment does not have.
    """
    if config.garment is None:
        return tshirt_pattern(person, config.style)
    return GARMENTS[config.garment].draft(person, parse_style(config.garment, config.cut or ()))


def is_held_at_waist(config: SynthConfig) -> bool:
    """Trousers and skirts are; shirts hang on the shoulders."""
    return config.garment is not None and GARMENTS[config.garment].hang is not None


def dressing_pose(config: SynthConfig, person: ShapedBody) -> np.ndarray | None:
    """Joint rotations, (J, 3, 3), in which the garment is put on; None: the arms held out, as for a T-shirt."""
    return None if config.garment is None else GARMENTS[config.garment].dressing(person)


def put_on(config: SynthConfig, person: ShapedBody, mesh: PanelMesh, pattern: Pattern, first: PosedBody) -> PutOn:
    """Put the garment around the body.

    Args:
        first: the body in the dressing pose, where the take begins; only the place of its root matters.
    """
    rotations = dressing_pose(config, person)
    if rotations is None or not is_held_at_waist(config):
        return PutOn(dress(person, mesh, pattern, first, rotations), None)
    assert config.garment is not None
    body = with_pose(person, rotations, np.zeros(3))
    points = hung(config.garment, mesh, pattern, body)
    held_from = GARMENTS[config.garment].held_from(person, points, mesh)
    points = clear_of_body(points, mesh, TriangleScene((body.vertices(), person.body.template.faces)))
    root = first.transforms[0]
    return PutOn(points @ root[:3, :3].T + root[:3, 3], held_from)


def template_weights(config: SynthConfig, points: np.ndarray, body: PosedBody) -> np.ndarray | None:
    """Skin weights, (V, J), of a template that hangs loose on a body in the dressing pose; None: the skin beneath's."""
    if config.garment != "skirt":
        return None
    near = np.asarray(GARMENTS["skirt"].parts(body.shaped).any(axis=0))
    return loose_weights(points, body, near=near, follow=config.skirt_weights or "distance")
