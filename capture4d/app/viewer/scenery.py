"""Light, floor and camera of a page that viser draws."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from capture4d.files.optional_packages import VISER, package_module

__all__ = ["open_server", "set_scene"]

_LIGHTS = {"key": ((1.2, 2.0, 2.4), 1.6), "fill": ((-2.2, 0.6, 1.6), 0.5), "back": ((0.4, 1.6, -2.4), 0.9)}
"""Where lights stand, metres from the subject, and how strong they are."""
_AMBIENT = 0.5
_ASIDE = np.array([0.16, 0.0, 0.0])
"""The camera looks so far, of the diagonal of the box, past it: the controls lie over the right of the page."""


def open_server(host: str, port: int, title: str) -> Any:
    """A `viser.ViserServer`; untyped, for viser may be absent.

    Raises:
        InputError: viser is not installed; says how it is.
    """
    viser = package_module(VISER, "")
    server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(control_width="large", dark_mode=False, show_share_button=False, show_logo=False)
    return server


def set_scene(server: Any, box: Float64[np.ndarray, "2 3"]) -> None:
    """Light what is in a box, put a floor under it and look at it from the front, a little from the subject's left."""
    scene, camera = server.scene, server.initial_camera
    low, high = box
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.1)
    scene.set_up_direction("+y")
    scene.configure_default_lights(enabled=False)
    scene.add_light_ambient("/light/ambient", intensity=_AMBIENT)
    for name, (place, strength) in _LIGHTS.items():
        where = tuple((centre + np.array(place)).tolist())
        scene.add_light_point(f"/light/{name}", intensity=strength, decay=0.0, position=where)
    floor = (float(centre[0]), float(low[1]), float(centre[2]))
    scene.add_grid("/floor", 4.0, 4.0, plane="xz", cell_size=0.25, section_size=1.0, position=floor)
    aside = centre + size * _ASIDE
    camera.look_at = tuple(aside.tolist())
    camera.position = tuple((aside + size * np.array([0.3, 0.15, 1.05])).tolist())
    camera.up = (0.0, 1.0, 0.0)
