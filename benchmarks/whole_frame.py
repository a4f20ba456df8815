"""What a frame costs from its scan to the registered template, with poses that are tracked: all stages but the report.

A take grows by some frames, so that what is done once a take (learning colours, searching for the first pose, loading
compiled loops) is done before.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.metric import Metric
from capture4d import pipeline
from capture4d.captures.capture import Capture

__all__ = ["whole_frame_metrics"]


def whole_frame_metrics(
    capture: Capture, work: Path, register_cpu_s: float, nricp_cpu_s: float, *, frames: int = 16
) -> list[Metric]:
    """CPU seconds a frame of `extract` and `track`, and of all three stages; these also over what nricp_amberg takes.

    Args:
        work: a new folder.
        register_cpu_s: of a frame, as it was measured.
        frames: so many are taken, if there are so many; the second half of them is measured.
    """
    ids = capture.frame_ids[:frames]
    first, added = ids[: len(ids) // 2], len(ids) - len(ids) // 2

    def cost(stage: Callable[[Capture], object]) -> float:
        stage(capture.choosing(",".join(map(str, first))))
        begin = time.process_time()
        stage(capture.choosing(",".join(map(str, ids))))
        return (time.process_time() - begin) / added

    extract_s = cost(lambda take: pipeline.extract(take, work, for_tracking=True))
    track_s = cost(lambda take: pipeline.track(take, work))
    total = extract_s + track_s + register_cpu_s
    return [
        Metric("extract_cpu_s", extract_s, "s"),
        Metric("track_cpu_s", track_s, "s"),
        Metric("stages_cpu_s", total, "s"),
        Metric("stages_cpu_ratio_to_nricp_amberg", total / nricp_cpu_s),
    ]
