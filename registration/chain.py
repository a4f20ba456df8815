"""What each frame of a take is registered from: its garment, and the frame that it starts from, segment by segment.

    frames/000123.npz    a frame as it stays
    tails/000123.npz     one of the last frames of a segment, as that segment has it, ...
    leads/000123.npz     ... and as the segment after it has it, which finds its way in the first of these
    seams/000123.json    how the segment that begins with this frame goes together with the one before

A frame with a tail is blended from its tail and its lead (`registration.seams`). Where these are too far apart the
segment after them is registered from the last tail, and tails stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from capture4d.captures.segments import Segment
from capture4d.runs.frame_lists import frame_file
from capture4d.runs.made import Ledger, Made
from registration.seams import faded, share_of_later

__all__ = ["Chain", "Link", "Todo"]

Link: TypeAlias = tuple[int, Path] | None
"""Position and file of the frame that the next one starts from; None where there is none."""


@dataclass(frozen=True, slots=True)
class Todo:
    """What there is to do now; when it is done there may be more."""

    join: tuple[Segment, ...]
    """Segments that are to be joined with the ones before; first, for some may have to be registered anew then."""
    register: tuple[Segment, ...]
    certain: tuple[int, ...]
    """Positions whose frames are to be made."""
    following: tuple[int, ...]
    """Positions whose frames are to be made if what they start from comes out otherwise than it was."""

    @property
    def is_any(self) -> bool:
        return bool(self.join or self.register)


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """What each frame would be made from, by position in the take."""

    ledger: Ledger
    frame_ids: tuple[int, ...]
    settings: str
    """Digest of what all frames share: settings, template, body."""
    garments: tuple[str, ...]
    """Digest of the garment of each frame's scan."""
    poses: tuple[str, ...]
    """Of each frame's pose; empty without poses."""
    segments: tuple[Segment, ...]
    seam_mm: float
    """What blending may add to a frame's motion."""
    reads_before: bool
    """Whether a frame starts from the one before; else it matters only that there is one."""

    # --- places ------------------------------------------------------------------------------------------------

    def file(self, position: int, folder: str = "frames", suffix: str = ".npz") -> Path:
        return frame_file(self.ledger.folder, self.frame_ids[position], suffix, folder)

    def leads(self, segment: Segment) -> dict[int, Path]:
        """A segment's version of the frames before its first."""
        return {position: self.file(position, "leads") for position in range(segment.lead, segment.start)}

    def frames(self, segment: Segment) -> dict[int, Path]:
        """A segment's version of its frames: as they stay, but for the last of them."""
        fading = self.fading_after(segment)
        return {
            position: self.file(position, "tails" if position in fading else "frames")
            for position in range(segment.start, segment.stop)
        }

    def seam(self, segment: Segment) -> Path:
        """What is known of the seam before a segment."""
        return self.file(segment.start, "seams", ".json")

    def fading(self, segment: Segment) -> range:
        """Positions in which the segment before fades into this one."""
        return range(segment.start - faded(segment.start - segment.lead), segment.start)

    def fading_after(self, segment: Segment) -> range:
        """Positions in which a segment fades into the next."""
        return self.fading(self.segments[segment.index + 1]) if segment.index + 1 < len(self.segments) else range(0)

    # --- frames ------------------------------------------------------------------------------------------------

    def inputs(self, position: int, before: Link) -> dict[str, str]:
        """What a frame is registered from, if it can start from another."""
        found = {"settings": self.settings, "garment": self.garments[position], "pose": self.poses[position]}
        if before is None or not self.reads_before:
            return {**found, "start": "distant" if before is None else "near"}
        return {**found, "start": f"{self.made(before[1]).digest} {self.poses[before[0]]}"}

    def walk(self, places: Mapping[int, Path], begin: Link) -> tuple[int | None, Link]:
        """The first of frames that is to be registered, None if all stand; and the last sound one before that."""
        for position, path in places.items():
            if not self.ledger.stands(path, self.inputs(position, begin)):
                return position, begin
            begin = (position, path) if self.made(path).said["sound"] else begin
        return None, begin

    def continues(self, segment: Segment) -> bool:
        """Whether a segment is registered from the end of the one before, as far as is known by now."""
        made = self.ledger.of(self.seam(segment)) if segment.index else None
        return made is not None and bool(made.said["continues"])

    def end_before(self, segment: Segment) -> Link:
        """The last sound tail before a segment."""
        tails = ((position, self.file(position, "tails")) for position in reversed(self.fading(segment)))
        return next((each for each in tails if self.made(each[1]).said["sound"]), None)

    def begin(self, segment: Segment) -> Link:
        """Where a segment's own frames start from, once what is before them stands."""
        if self.continues(segment):
            return self.end_before(segment)
        return self.walk(self.leads(segment), None)[1]

    # --- seams -------------------------------------------------------------------------------------------------

    def seam_inputs(self, segment: Segment) -> dict[str, str]:
        """What the seam before a segment is judged by."""
        places = [self.file(each, folder) for each in self.fading(segment) for folder in ("tails", "leads")]
        return {"limit": f"{self.seam_mm:g}", "frames": self.ledger.digest_of(places)}

    def blend_inputs(self, segment: Segment, position: int) -> dict[str, str]:
        """What a frame with a tail is made from, once the seam is known."""
        tail = {"tail": self.made(self.file(position, "tails")).digest}
        if self.continues(segment):
            return tail
        fading = self.fading(segment)
        return {
            **tail,
            "settings": self.settings,
            "garment": self.garments[position],
            "lead": self.made(self.file(position, "leads")).digest,
            "share": repr(share_of_later(position - fading.start, len(fading))),
            "seam": self.made(self.seam(segment)).digest,
        }

    def is_joined(self, segment: Segment) -> bool:
        """Whether the seam before a segment, and the frames in which the two fade, stand, as tails and leads do."""
        return self.ledger.stands(self.seam(segment), self.seam_inputs(segment)) and all(
            self.ledger.stands(self.file(each), self.blend_inputs(segment, each)) for each in self.fading(segment)
        )

    # --- what there is to do -----------------------------------------------------------------------------------

    def todo(self) -> Todo:
        """What there is to do now."""
        join, register, certain, following = [], [], set[int](), set[int]()
        stands_before = True
        for segment in self.segments:
            stale, _ = self.walk(self.leads(segment), None)
            unjoined = bool(segment.index) and stands_before and stale is None and not self.is_joined(segment)
            waits = self.continues(segment) and not stands_before
            if stale is None and not waits:
                stale, _ = self.walk(self.frames(segment), self.begin(segment))
            if unjoined:
                join.append(segment)
            if stale is not None:
                certain.add(stale)
                following |= {*range(stale + 1, segment.stop)}
            if waits or unjoined:
                following |= {*range(self.fading(segment).start, segment.stop)}
            if not waits and stale is not None:
                register.append(segment)
            stands_before = stale is None and not waits
        return Todo(tuple(join), tuple(register), tuple(sorted(certain)), tuple(sorted(following - certain)))

    def made(self, path: Path) -> Made:
        made = self.ledger.of(path)
        assert made is not None, path
        return made
