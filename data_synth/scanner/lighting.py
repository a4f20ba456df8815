"""Light on the scanned surfaces: even, strongly from one side or from above, or in two colour temperatures.

Lamps stand still while the subject moves. Except under even light, which is the weak shading of a diffuse cage, light
is added in linear light, Lambert's law and the square of the distance included, and encoded as sRGB.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import assert_never

import numpy as np
from jaxtyping import Float32

from capture4d.colours.spaces import nearly_encoded, nearly_linear
from capture4d.geometry.mesh import vertex_normals
from capture4d.types import Rig
from data_synth.scanner.config import Lighting, ShadingConfig
from data_synth.scanner.raycast import Surface

__all__ = ["flicker", "light"]


@dataclass(frozen=True, slots=True)
class _Lamp:
    place: tuple[float, float, float]
    """From the middle of the rig, relative to the distance of its cameras."""
    colour: tuple[float, float, float]
    """Linear light at the middle of the rig, head-on."""


@dataclass(frozen=True, slots=True)
class _Lamps:
    ambient: tuple[float, float, float]
    lamps: tuple[_Lamp, ...]


# 3200 K and 6500 K as a camera balanced for 4300 K sees them.
WARM, COOL = np.array([1.0, 0.85, 0.64]), np.array([0.66, 0.8, 1.0])


FLICKER = 0.03
"""Standard deviation of the overhead lamp's strength from frame to frame, channel by channel."""


def _times(colour: np.ndarray, strength: float) -> tuple[float, float, float]:
    red, green, blue = (strength * colour).tolist()
    return red, green, blue


LAMPS: Mapping[Lighting, _Lamps] = {
    "side": _Lamps((0.16, 0.16, 0.16), (_Lamp((0.8, 0.25, 0.3), (0.6, 0.6, 0.6)),)),
    "overhead": _Lamps((0.3, 0.3, 0.3), (_Lamp((0.3, 0.8, 0.5), (0.6, 0.6, 0.6)),)),
    "two-temperature": _Lamps(
        (0.2, 0.2, 0.2), (_Lamp((0.8, 0.3, 0.5), _times(WARM, 0.55)), _Lamp((-0.8, 0.2, 0.1), _times(COOL, 0.55)))
    ),
}


def light(surface: Surface, rig: Rig, *, shading: ShadingConfig) -> Float32[np.ndarray, "verts 3"]:
    """Vertex colours, sRGB from 0 to 1; brighter ones are clipped by the cameras."""
    normals = vertex_normals(surface.mesh.vertices, surface.mesh.faces)
    match shading.lighting:
        case "even":
            return _even(surface, normals, shading.ambient)
        case "side" | "overhead" | "two-temperature":
            return _lamplit(surface, normals, LAMPS[shading.lighting], rig)
        case _:
            assert_never(shading.lighting)


def flicker(shading: ShadingConfig, rng: np.random.Generator) -> Float32[np.ndarray, " 3"]:
    """What a frame's light is off by, channel by channel; only the overhead lamp flickers, and draws from `rng`."""
    if shading.lighting != "overhead":
        return np.ones(3, np.float32)
    return (1 + FLICKER * rng.standard_normal(3)).astype(np.float32)


def _even(surface: Surface, normals: np.ndarray, ambient: float) -> np.ndarray:
    """An even light and two weak lamps, front left and back right of the subject."""
    key = np.array([0.45, 0.6, 0.66], np.float32)
    fill = np.array([-0.6, 0.2, -0.77], np.float32)
    lamps = 0.75 * np.clip(normals @ key, 0, None) + 0.45 * np.clip(normals @ fill, 0, None)
    shade = ambient + (1 - ambient) * 1.5 * lamps
    return (surface.colours.astype(np.float32) / 255 * shade[:, None]).astype(np.float32)


def _lamplit(surface: Surface, normals: np.ndarray, lights: _Lamps, rig: Rig) -> np.ndarray:
    centre = rig.centres.mean(axis=0)
    reach = float(np.linalg.norm(rig.centres - centre, axis=1).mean())
    total = np.tile(np.array(lights.ambient), (len(normals), 1))
    for lamp in lights.lamps:
        place = np.array(lamp.place) * reach
        toward = centre + place - surface.mesh.vertices
        distance = np.linalg.norm(toward, axis=1)
        lambert = np.clip(np.einsum("ij,ij->i", toward, normals) / distance, 0, None)
        total += (lambert * (place @ place) / distance**2)[:, None] * np.array(lamp.colour)
    linear = nearly_linear(surface.colours / 255.0) * total
    return nearly_encoded(linear).astype(np.float32)
