"""Which frame it is while a take is played: frames that are late are left out, not queued."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["Clock"]


@dataclass(frozen=True, slots=True)
class Clock:
    """A take that was started at a frame, at a time, at a speed."""

    frame_ids: Sequence[int]
    fps: float
    speed: float
    """1 is the take's own; negative plays backwards."""
    from_frame: int
    started_s: float

    def frame(self, now_s: float) -> int:
        """The frame that is due; past the last the take begins again."""
        ids = self.frame_ids
        span = ids[-1] - ids[0] + 1
        at = self.from_frame - ids[0] + (now_s - self.started_s) * self.fps * self.speed
        row = int(np.searchsorted(ids, ids[0] + at % span, side="right")) - 1
        return ids[max(row, 0)]

    def next_frames(self, frame_id: int, count: int) -> list[int]:
        """Those that are due after a frame, the next one first."""
        ids = self.frame_ids
        row = int(np.searchsorted(ids, frame_id))
        step = 1 if self.speed >= 0 else -1
        return [ids[(row + step * each) % len(ids)] for each in range(1, count + 1)]
