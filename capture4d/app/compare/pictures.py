"""The pictures of a comparison: every surface of a frame, its error in the map, and the garment on other people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from capture4d.app.compare.garment import Modelled
from capture4d.app.compare.methods import NETWORK, Method, Surfaces
from capture4d.app.drawing.palette import CLOTH, HEIGHT, SKIN, WIDTH
from capture4d.app.drawing.panels import Framing, Panel, Scale, data_uri, no_scan, readable_scan
from capture4d.app.drawing.render import Drawn, View, heat_colours, render
from capture4d.captures.capture import Capture
from capture4d.captures.truth import TruthModel, read_truth_vertices
from wrinkles.normal_maps.display import fill_holes
from wrinkles.normal_maps.metrics import angles
from wrinkles.normal_maps.pairs import PairTake
from wrinkles.normal_maps.template import MapTemplate

__all__ = ["FramePictures", "Pictures", "draw"]

ERROR_DEG = 30.0
"""Normal error at which the strip's colours end."""


@dataclass(frozen=True, slots=True, eq=False)
class FramePictures:
    """One held-out frame."""

    frame_id: int
    panels: Sequence[Panel]
    strip: Sequence[Panel]
    """The angle of every surface's normals to the scan's, in the map."""


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """Some held-out frames, and the one in their middle on other people."""

    frames: Sequence[FramePictures]
    people: Sequence[Panel]
    people_frame: int
    scale: Scale
    """Of the angles in the strips."""


def draw(
    surfaces: Surfaces,
    template: MapTemplate,
    held: PairTake,
    capture: Capture,
    truth: TruthModel | None,
    *,
    count: int,
    middle: int,
) -> Pictures:
    """Draw everything.

    Args:
        template: referred to the pairs' own.
        count: frames to draw.
        middle: position in the take of the frame that other people wear.
    """
    total = len(held.frame_ids)
    chosen = np.unique(np.linspace(0, total - 1, min(count, total)).astype(int)).tolist()
    frames, drawn = [], []
    for at in chosen:
        angle_of = _map_errors(template, surfaces.methods, held, at)
        strip = [Panel(name, _heat(angle)) for name, angle in angle_of.items()]
        panels = _Frame(surfaces, template, held, at).panels(capture, truth)
        frames.append(FramePictures(int(held.frame_ids[at]), panels, strip))
        drawn += [angle[np.isfinite(angle)] for angle in angle_of.values()]
    people = [] if surfaces.modelled is None else _people(surfaces.modelled, middle)
    scale = Scale.ending("angle", ERROR_DEG, np.concatenate(drawn), "deg")
    return Pictures(frames, people, int(held.frame_ids[total // 2]), scale)


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A held-out frame, all of whose pictures are taken from one side."""

    surfaces: Surfaces
    template: MapTemplate
    held: PairTake
    at: int
    """Its position among them."""

    def panels(self, capture: Capture, truth: TruthModel | None) -> list[Panel]:
        """The scan, the truth if there is one, every surface without and with the network's map, and the registration
        with its low map and with the scan's."""
        frame_id, view = int(self.held.frame_ids[self.at]), self._view()
        scan = readable_scan(capture, frame_id)
        panels = [no_scan()]
        if scan is not None:
            shown = render([Drawn(scan.mesh, scan.colours)], view, width=WIDTH, height=HEIGHT)
            panels = [Panel("scan", data_uri(shown))]
        if truth is not None:
            fine = truth.fine.with_vertices(read_truth_vertices(capture, frame_id))
            panels.append(Panel("truth", data_uri(render([Drawn(fine)], view, width=WIDTH, height=HEIGHT))))
        for method in self.surfaces.methods:
            panels += self._of(method, view)
        registration = self.surfaces.methods[0]
        placed = registration.vertices[self.at]
        low = self._tangent_image(registration.normals[self.at], placed)
        panels.append(Panel("low map", self._drawn(view, placed, low)))
        return [*panels, Panel("map of the scan", self._drawn(view, placed, self._scan_map(placed)))]

    def _of(self, method: Method, view: View) -> list[Panel]:
        """A surface with its map; or without, and with the one that the network makes of it."""
        vertices = method.vertices[self.at]
        if method.has_map:
            image = self._tangent_image(method.normals[self.at], vertices)
            return [Panel(method.name, self._drawn(view, vertices, image))]
        panels = [Panel(method.name, self._drawn(view, vertices))]
        if method is not self.surfaces.methods[0]:  # whose picture with the network's map is the network's
            image = self._tangent_image(self.surfaces.maker.normals(vertices), vertices)
            panels.append(Panel(f"{method.name}, {NETWORK}'s map", self._drawn(view, vertices, image)))
        return panels

    def _scan_map(self, placed: np.ndarray) -> np.ndarray:
        """The scan's map in tangent space, its holes filled."""
        raster, high = self.template.raster, self.held.high[self.at].float().permute(1, 2, 0).numpy()
        valid = raster.read(self.held.valid[self.at, 0].numpy())
        world = raster.read(high) @ self.template.rotation(placed).T
        filled = fill_holes(self._tangent_image(world, placed), raster.image(valid))
        filled[..., 2] = np.where(np.abs(filled).sum(axis=-1) > 0, filled[..., 2], 1)
        return filled

    def _view(self) -> View:
        registered = self.surfaces.methods[0].vertices
        span = np.ptp(registered.reshape(len(registered), -1, 3), axis=1).max(axis=0)
        framing = Framing((float(span[0]), float(span[1]), float(span[2])))
        return framing.view(registered[self.at], "three_quarter")

    def _drawn(self, view: View, vertices: np.ndarray, normal_map: np.ndarray | None = None) -> str:
        mesh = self.template.mesh.with_vertices(vertices)
        return data_uri(render([Drawn(mesh, normal_map=normal_map)], view, width=WIDTH, height=HEIGHT))

    def _tangent_image(self, normals: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        return self.template.tangent_image(normals, vertices)


def _map_errors(template: MapTemplate, methods: Sequence[Method], held: PairTake, at: int) -> dict[str, np.ndarray]:
    """The angle of every method's normals to the scan's, in the map, degrees; NaN where the scan says nothing."""
    rotation, valid = template.rotation(methods[0].vertices[at]), held.valid[at].numpy()[0]
    errors = {}
    for method in methods:
        image = template.raster.image((method.normals[at] @ rotation).astype(np.float32))
        angle = angles(torch.from_numpy(image).permute(2, 0, 1)[None], held.high[at].float()[None])[0, 0].numpy()
        errors[method.name] = np.where(valid, angle, np.nan)
    return errors


def _heat(angle: np.ndarray) -> str:
    return data_uri(heat_colours(angle.ravel(), high=ERROR_DEG).reshape(*angle.shape, 3))


def _people(modelled: Modelled, row: int) -> list[Panel]:
    """A frame on other people, all drawn at one scale."""
    dressed = modelled.on_people(row)
    spans = np.max([np.ptp(each.garment.vertices, axis=0) for each in dressed], axis=0).tolist()
    framing = Framing((1.3 * spans[0], 1.15 * spans[1], 1.3 * spans[2]))
    return [
        Panel(
            each.who,
            data_uri(
                render(
                    [Drawn(each.garment, CLOTH), Drawn(each.body, SKIN)],
                    framing.view(each.garment.vertices, "three_quarter"), width=WIDTH, height=HEIGHT,
                )
            ),
        )
        for each in dressed
    ]  # fmt: skip
