"""Which layers of which takes are shown, how they are coloured, and what the browser is sent of a frame."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from capture4d.app.viewer.figures import FIGURES
from capture4d.app.viewer.kept import Kept
from capture4d.app.viewer.surfaces import Dots, Surface, surface_glb
from capture4d.app.viewer.take import CLOTH_LAYER, MAPS, SCAN, ShownTake
from capture4d.errors import InputError

__all__ = ["Choice", "Payload", "Presenter"]

Payload = bytes | Dots
"""A surface as glTF, or points."""
GAP = 0.3
"""Between two takes side by side, in widths of the wider one."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the user wants to see."""

    layers: frozenset[str]
    paint: str
    high: float
    """What the end of the figure's colours stands for."""
    full: bool = False
    """Scans as they are, not their previews."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A frame: by take and layer what is shown of it, None where there is nothing."""

    frame_id: int
    payloads: Mapping[tuple[int, str], Payload | None]
    faults: Sequence[str] = field(default_factory=tuple)
    """Of what could not be read, a line each."""


class Presenter:
    """Frames of one take, or of several side by side, ready to be sent; for several threads.

    Args:
        memory_mb: in which frames that were made are kept.
    """

    def __init__(self, takes: Sequence[ShownTake], memory_mb: int) -> None:
        self.takes = takes
        self._kept: Kept[Payload | None] = Kept(memory_mb * 2**20, _size)
        self._looking = threading.Lock()

    @property
    def kept_bytes(self) -> int:
        return self._kept.bytes

    @property
    def frame_ids(self) -> tuple[int, ...]:
        """Of all takes, ascending."""
        return tuple(sorted({*(each for take in self.takes for each in take.timeline.frame_ids)}))

    @property
    def layers(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(layer for take in self.takes for layer in take.layers))

    @property
    def paints(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(paint for take in self.takes for paint in take.paints))

    def first_choice(self) -> Choice:
        """What is shown at first: the registration by its fit, or with wrinkles; the scan where that is all."""
        paints = self.paints
        paint = MAPS if MAPS in paints else paints[0] if paints else ""
        wanted = {CLOTH_LAYER} & {*self.layers} or {SCAN} & {*self.layers} or {*self.layers[:1]}
        return Choice(frozenset(wanted), paint, FIGURES[paint].high if paint in FIGURES else 1.0)

    def look(self) -> bool:
        """Look for new frames in all takes; whether there is anything new."""
        with self._looking:
            changed = [take.look() for take in self.takes]
            return any(changed)

    def picture(self, frame_id: int, choice: Choice) -> Picture:
        """What the browser is sent of a frame."""
        payloads: dict[tuple[int, str], Payload | None] = {}
        faults = []
        for number, take in enumerate(self.takes):
            for layer in sorted(choice.layers & {*take.layers}):
                paint = choice.paint if choice.paint in take.paints else "plain"
                key = self._key(number, layer, frame_id, choice, paint)
                try:
                    payloads[number, layer] = self._kept.get(
                        key, lambda take=take, layer=layer, paint=paint: _made(take, layer, frame_id, choice, paint)
                    )
                except (InputError, OSError) as error:
                    payloads[number, layer] = None
                    faults.append(str(error))
                except (IndexError, KeyError, ValueError):  # files of two templates, while one replaces the other
                    payloads[number, layer] = None
                    faults.append(f"{take.name}: {layer} of frame {frame_id} is being written anew")
        return Picture(frame_id, payloads, tuple(faults))

    def _key(self, number: int, layer: str, frame_id: int, choice: Choice, paint: str) -> tuple:
        state = self.takes[number].state(layer, frame_id)
        coloured = (paint, choice.high) if layer == CLOTH_LAYER else ()
        return (number, layer, frame_id, state, layer == SCAN and choice.full, *coloured)

    def forget(self) -> None:
        """Keep nothing of what was made."""
        self._kept.clear()

    def offsets_m(self) -> list[float]:
        """How far each take is moved along x, so that they stand side by side."""
        if len(self.takes) == 1:
            return [0.0]
        boxes = [self.box(number) for number in range(len(self.takes))]
        widths = [float(np.ptp(box[:, 0])) for box in boxes]
        step = (1 + GAP) * max(widths)
        return [number * step - float(box[:, 0].mean() - boxes[0][:, 0].mean()) for number, box in enumerate(boxes)]

    def box(self, number: int = 0) -> np.ndarray:
        """Least and greatest corner (2, 3) of what a take shows in its first frame that shows anything, metres."""
        take = self.takes[number]
        for frame_id in take.timeline.frame_ids[:50]:
            found = []
            for layer in take.layers:
                try:
                    shown = take.shown(layer, frame_id)
                except (InputError, OSError):
                    continue
                if shown is not None:
                    found.append(shown.mesh.vertices if isinstance(shown, Surface) else shown.points)
            if found:
                points = np.concatenate(found).astype(np.float64)
                return np.stack([points.min(axis=0), points.max(axis=0)])
        return np.array([[-0.5, 0.0, -0.5], [0.5, 1.8, 0.5]])


def _made(take: ShownTake, layer: str, frame_id: int, choice: Choice, paint: str) -> Payload | None:
    shown = take.shown(layer, frame_id, paint=paint, high=choice.high, full=choice.full)
    if isinstance(shown, Surface):
        return surface_glb(shown, take.corners() if shown.normal_map is not None else None)
    return shown


def _size(payload: Payload | None) -> int:
    if payload is None:
        return 64
    return len(payload) if isinstance(payload, bytes) else payload.points.nbytes + payload.colours.nbytes
