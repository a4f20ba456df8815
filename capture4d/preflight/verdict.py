"""What is wrong with a take: numbers of its frames in, findings out.

Every check gives a score, what was measured over what is tolerated: above 1 it is a finding. A finding names a cause
once; what merely follows from it (no garment colour in a scan without colours) is not reported again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from capture4d.captures.names import unknown_borders
from capture4d.colours.spaces import colour_angles, to_lab
from capture4d.preflight.facts import BadFrame, TakeFacts
from capture4d.preflight.findings import CODES, Code, Finding, Limits, Verdict
from capture4d.preflight.statistics import FrameStatistics
from capture4d.preflight.survey import MAX_FLOOR_M, MAX_SIZE_RATIO, Survey
from capture4d.units import METRES

__all__ = ["judge", "true_rate"]


def judge(
    facts: TakeFacts,
    survey: Survey | None,
    frames: Sequence[FrameStatistics],
    bad_frames: Sequence[BadFrame] = (),
    *,
    limits: Limits | None = None,
) -> Verdict:
    """Findings of a take.

    Args:
        survey: of its coordinates; None if no frame could be read.
        frames: what was looked at, in metres, Y up.
    """
    limits = limits or Limits()
    frames = sorted(frames, key=lambda frame: frame.frame_id)
    checks = [*_check_bad(bad_frames), *_check_numbers(facts), *_check_template(facts)]
    if survey is not None:
        checks += _check_survey(survey, facts, limits)
    if frames:
        checks += [_check_notes(frames), *_check_rate(facts, frames, limits)]
        checks += _check_surface(facts, frames, limits)
        checks += _check_colours(facts, frames, limits)
        checks += _check_poses(facts, survey, frames, limits)
    scores: dict[Code, float] = {}
    for check in checks:
        scores[check.code] = max(scores.get(check.code, 0.0), check.score)
    found = [check for check in checks if check.score > 1]
    order = {code: index for index, code in enumerate(CODES)}
    found.sort(key=lambda finding: (finding.severity != "error", order[finding.code]))
    return Verdict(tuple(found), scores)


# --- frames and numbers ------------------------------------------------------------------------------------------


def _check_bad(bad_frames: Sequence[BadFrame]) -> Iterator[Finding]:
    for code in ("frame-unreadable", "frame-empty", "frame-nan"):
        bad = sorted((bad for bad in bad_frames if bad.code == code), key=lambda bad: bad.frame_id)
        if bad:
            yield Finding(code, f"{_count(bad)}, first: {bad[0].reason}", _CERTAIN, tuple(b.frame_id for b in bad))
        else:
            yield Finding(code, "none", 0.0)


_CERTAIN = 10.0
"""Score of what is a fact, not a measurement; others are cut off here."""


def _check_notes(frames: Sequence[FrameStatistics]) -> Finding:
    noted = [frame for frame in frames if frame.notes]
    first = f", first: {'; '.join(noted[0].notes)}" if noted else ""
    text = f"something in the files of {_count(noted)} of {len(frames)} could not be used{first}"
    return Finding("read-in-part", text, _CERTAIN * bool(noted), tuple(frame.frame_id for frame in noted))


def _check_numbers(facts: TakeFacts) -> Iterator[Finding]:
    present = np.array(facts.frame_ids, np.int64)
    absent = set(facts.listed or ()) - set(facts.frame_ids)
    without = f"no scan for {_count(absent)} of the {len(facts.listed or ())} in capture.json" if absent else "none"
    yield Finding("frames-listed", without, _CERTAIN * bool(absent), _sorted(absent))
    listed, absent = absent, set[int]()
    if len(present) > 2:
        steps = np.diff(present)
        step = int(np.bincount(steps).argmax()) if steps.max() < 1_000_000 else int(np.median(steps))
        regular = {
            int(start) + step * (number + 1)
            for start, gap in zip(present, steps, strict=False)
            if gap > step and gap % step == 0 and gap // step < 10_000
            for number in range(gap // step - 1)
        }
        # Irregular numbers are a hand-picked selection; regular ones with gaps are not.
        if (steps == step).mean() >= 0.5:
            absent |= regular
    absent -= {*facts.dropped, *listed}
    if absent:
        yield Finding("frames-missing", f"{_count(absent)} of {len(present) + len(absent)}", _CERTAIN, _sorted(absent))
    else:
        yield Finding("frames-missing", "none", 0.0)
    if facts.duplicated:
        many = f"{_count(facts.duplicated)} with more than one file"
        yield Finding("frames-duplicated", many, _CERTAIN, facts.duplicated)
    else:
        yield Finding("frames-duplicated", "none", 0.0)
    unposed = set() if facts.pose_frames is None else set(facts.listed or facts.frame_ids) - set(facts.pose_frames)
    if unposed:
        yield Finding("poses-missing", f"no pose for {_count(unposed)}", _CERTAIN, _sorted(unposed))
    else:
        yield Finding("poses-missing", "none", 0.0)


def _check_template(facts: TakeFacts) -> Iterator[Finding]:
    yield Finding("template", facts.template_fault or "can be registered", _CERTAIN * bool(facts.template_fault))
    loops = facts.template_loops
    painted = [names[0] for names in facts.border_names if len(names) == 1 and not facts.borders_claimed]
    unknown = unknown_borders(painted, loops) if loops else ()
    said = f"paints named {', '.join(unknown)}; the template's borders are {', '.join(loops or ())}"
    yield Finding("borders-named", said if unknown else "as the template's", _CERTAIN * bool(unknown))


# --- coordinates -------------------------------------------------------------------------------------------------


def _check_survey(survey: Survey, facts: TakeFacts, limits: Limits) -> Iterator[Finding]:
    declared = next((name for name, metres in METRES.items() if metres == facts.declared), "?")
    unit = f"a person in {survey.units}" if survey.units else "in no known unit a person"
    yield Finding(
        "units",
        f"subject {survey.size_ratio:.3g} times too large or small in {declared}, {unit}",
        _capped(np.log(survey.size_ratio) / np.log(MAX_SIZE_RATIO)),
    )
    told = "motion capture" if survey.by_poses else "the figure"
    placement = survey.placement
    turned = not placement.mirrors and bool((placement.axes != np.eye(3)).any())
    yield Finding(
        "axes",
        f"up is {_axis_name(placement.axes[1])} by {told}, which fits {survey.axes_ratio:.2g} times better so",
        _capped(survey.axes_ratio) if turned else min(survey.axes_ratio, 1.0),
    )
    if survey.mirror_ratio is not None:
        yield Finding(
            "mirrored",
            f"mirrored, the scans fit motion capture {survey.mirror_ratio:.2g} times better",
            _capped(survey.mirror_ratio) if placement.mirrors else min(survey.mirror_ratio, 1.0),
        )
    inside_out = survey.outwardness < 0 and not placement.mirrors
    yield Finding(
        "winding",
        f"faces look inwards (outwardness {survey.outwardness:.2f})",
        _capped(-survey.outwardness / 0.08) if inside_out else 0.0,
    )
    limit = MAX_FLOOR_M if survey.floor_exact else limits.floor_rough_m
    sure = "" if survey.floor_exact else "about "
    yield Finding("floor", f"floor at y = {sure}{survey.floor_m:.2f} m", _capped(abs(survey.floor_m) / limit))


def _axis_name(row: np.ndarray) -> str:
    axis = int(np.abs(row).argmax())
    return f"{'-' if row[axis] < 0 else '+'}{'XYZ'[axis]}"


# --- rate --------------------------------------------------------------------------------------------------------


def _check_rate(facts: TakeFacts, frames: Sequence[FrameStatistics], limits: Limits) -> Iterator[Finding]:
    if facts.fps is None:
        return
    low, high = limits.fps_range
    checks = [(facts.fps / high, f"{facts.fps:g} frames a second"), (low / facts.fps, f"{facts.fps:g} frames a second")]
    rate = true_rate(facts, frames)
    if rate is not None:
        factor = max(rate / facts.fps, facts.fps / rate)
        text = f"{facts.fps:g} frames a second, but motion capture or time stamps say {rate:.4g}"
        checks.append((np.log(factor) / np.log(limits.fps_mismatch), text))
    speeds = [
        frame.shift_m * facts.fps / (frame.frame_id - frame.shift_from)
        for frame in frames
        if frame.shift_m is not None and frame.shift_from is not None
    ]
    if len(speeds) >= 2:
        fast = float(np.percentile(speeds, 90))
        checks.append((fast / limits.fastest_m_s, f"at {facts.fps:g} frames a second limbs move at {fast:.2g} m/s"))
        box = np.array([[*frame.lower, *frame.upper] for frame in frames])
        if np.ptp(box, axis=0).max() > limits.moved_m:
            text = f"at {facts.fps:g} frames a second nothing moves faster than {max(speeds):.2g} m/s"
            checks.append((limits.slowest_m_s / max(max(speeds), 1e-9), text))
    score, text = max(checks)
    yield Finding("fps", text, _capped(score))


def true_rate(facts: TakeFacts, frames: Sequence[FrameStatistics]) -> float | None:
    """Frames a second by time stamps in the files, or by motion capture; None if neither tells."""
    stamped = [(frame.frame_id, frame.time_s) for frame in frames if frame.time_s is not None]
    if len(stamped) >= 3:
        numbers, times = np.array(stamped, float).T
        ratio = np.median(np.diff(times) / np.diff(numbers))
        if ratio > 0:
            return float(1 / ratio)
    return facts.pose_fps


# --- surface -----------------------------------------------------------------------------------------------------


def _check_surface(facts: TakeFacts, frames: Sequence[FrameStatistics], limits: Limits) -> Iterator[Finding]:
    ids = np.array([frame.frame_id for frame in frames])
    size = np.sqrt([frame.area_m2 for frame in frames])
    spacing = np.array([frame.spacing_m for frame in frames])
    usual = np.median(size[size >= 0.9 * np.percentile(size, 75)])
    outside = _outside(frames, size / usual, limits)
    yield _per_frame("outside-volume", ids, outside, "the garment leaves the volume")
    inside = outside <= 1
    partial = np.where(inside, np.log(size / usual) / np.log(limits.partial_area), 0)
    yield _per_frame("frame-partial", ids, partial, "much less surface than usual")
    steps = np.log(np.stack([size / np.median(size), spacing / np.median(spacing)]))
    common = np.where(np.sign(steps[0]) == np.sign(steps[1]), np.abs(steps).min(axis=0), 0)
    jump = np.where(inside, common, 0) / limits.scale_step
    yield _per_frame("scale-jump", ids, jump, f"{100 * np.expm1(common.max()):.0f} % larger or smaller than the rest")
    noise = np.array([frame.noise for frame in frames])
    yield _per_frame("noise", ids, noise / limits.noise, f"noise of {noise.max():.2g} vertex spacings")
    holes = np.where(inside, [frame.hole_share for frame in frames], 0)
    yield _per_frame(
        "holes", ids, holes / limits.hole_share, f"holes of up to {100 * holes.max():.0f} % of the surface"
    )
    clouds = [frame.frame_id for frame in frames if frame.estimated]
    text = f"points alone in {_count(clouds)} of {len(frames)}; normals and faces are estimated"
    yield Finding("faces-missing", text, _CERTAIN * bool(clouds), _sorted(clouds))
    first: dict[str, int] = {}
    copies = [frame.frame_id for frame in frames if first.setdefault(frame.content, frame.frame_id) != frame.frame_id]
    yield Finding(
        "frame-repeated", f"{_count(copies)} the same as an earlier one", _CERTAIN * bool(copies), _sorted(copies)
    )


def _outside(frames: Sequence[FrameStatistics], size: np.ndarray, limits: Limits) -> np.ndarray:
    """Score of every frame for leaving the volume, (T,)."""
    if all(frame.camera_share is not None for frame in frames):
        share = np.array([frame.camera_share for frame in frames], float)
        lost = 1 - share / max(np.percentile(share, 90), 1e-9)
        beside = share / np.maximum([frame.best_share or 0.0 for frame in frames], 1e-3)
        return np.maximum(lost / limits.cameras_lost, limits.cameras_least / np.maximum(beside, 1e-3))
    centre = np.array([frame.centre for frame in frames])[:, [0, 2]]
    whole = size >= 0.95
    away = np.linalg.norm(centre - np.median(centre[whole], axis=0), axis=1) if whole.any() else np.zeros(len(size))
    shrunk = np.log(np.minimum(size, 1)) / np.log(limits.partial_area)
    return np.minimum(away / limits.left_m, shrunk)


def _per_frame(code: Code, ids: np.ndarray, scores: np.ndarray, text: str) -> Finding:
    bad = tuple(int(number) for number in ids[scores > 1])
    return Finding(code, f"{text}, in {_count(bad)} of {len(ids)}", _capped(float(scores.max())), bad)


# --- colours -----------------------------------------------------------------------------------------------------


def _check_colours(facts: TakeFacts, frames: Sequence[FrameStatistics], limits: Limits) -> Iterator[Finding]:
    coloured = [frame.colours for frame in frames if frame.colours is not None]
    bare = [frame.frame_id for frame in frames if frame.colours is None]
    yield Finding(
        "colours-missing", f"no colours in {_count(bare)} of {len(frames)}", _CERTAIN * bool(bare), _sorted(bare)
    )
    if not coloured:
        return
    chroma = float(np.median([colours.chroma for colours in coloured]))
    faded = limits.chroma / max(chroma, 1e-3)
    text = f"chroma of {chroma:.3g}"
    garment = facts.paints.garment
    if garment is not None:
        wanted = float(np.hypot(*to_lab(np.array([garment], np.uint8))[0, 1:]))
        shown = [colours.garment_chroma for colours in coloured if np.isfinite(colours.garment_chroma)]
        if wanted > 15 and shown:
            faded = limits.chroma_share * wanted / max(float(np.median(shown)), 1e-3)
            text = f"the garment's chroma is {np.median(shown):.3g} instead of {wanted:.3g}"
        elif wanted <= 15:  # grey cloth on a grey suit has no colour to lose
            faded = 0.0
    clipped = float(np.median([colours.clipped for colours in coloured])) / limits.clipped_share
    if clipped > faded:
        text = f"{100 * clipped * limits.clipped_share:.0f} % of the surface is overexposed"
    yield Finding("colours-washed-out", text, _capped(max(faded, clipped)))
    if garment is None or max(faded, clipped) > 1:
        return
    cloth = float(np.median([colours.garment for colours in coloured]))
    absent = limits.garment_share / max(cloth, 1e-6)
    yield Finding("garment-absent", f"{100 * cloth:.2g} % of the surface has the garment's colour", _capped(absent))
    if absent > 1:
        return
    spreads = [colours.garment_spread for colours in coloured if np.isfinite(colours.garment_spread)]
    spread = float(np.median(spreads)) if spreads else 0.0
    for index, paint in enumerate(facts.paints.borders):
        names = ", ".join(facts.border_names[index]) if index < len(facts.border_names) else f"paint {index + 1}"
        others = np.array([garment, *facts.paints.borders[:index]], np.uint8)
        angle = float(colour_angles(others, paint).min())
        close = max(limits.paint_angle, 2 * spread) / max(angle, 1e-3)
        yield Finding(
            "border-not-separable", f"{names}: {angle:.2f} rad from another paint or the cloth", _capped(close)
        )
        if close > 1:
            continue
        share = float(np.median([colours.borders[index] for colours in coloured])) / cloth
        absent = limits.border_share / max(share, 1e-6)
        yield Finding("border-absent", f"{names}: {100 * share:.2g} % as much as cloth", _capped(absent))
        if absent <= 1:
            stray = float(np.median([colours.stray[index] for colours in coloured]))
            text = f"{names}: {100 * stray:.0f} % of its colour is away from the cloth"
            yield Finding("border-on-body", text, _capped(stray / limits.stray_share))


# --- poses -------------------------------------------------------------------------------------------------------


def _check_poses(
    facts: TakeFacts, survey: Survey | None, frames: Sequence[FrameStatistics], limits: Limits
) -> Iterator[Finding]:
    if survey is not None and survey.person_ratio is not None:
        text = f"the body in the scans differs from that of the motion capture by {1e3 * survey.person_m:.0f} mm"
        yield Finding("poses-mismatch", text, _capped(survey.person_ratio))
    measured = [frame for frame in frames if frame.pose_distance_m is not None]
    if not measured:
        return
    distance = np.array([frame.pose_distance_m for frame in measured], float)
    told = [frame.colours is not None and 0.02 < frame.colours.garment < 0.85 for frame in measured]
    limit = np.where(told, limits.pose_distance_m, limits.pose_distance_dressed_m)
    ids = np.array([frame.frame_id for frame in measured])
    text = f"scans up to {1e3 * distance.max():.0f} mm from the posed body"
    yield _per_frame("poses-mismatch", ids, distance / limit, text)


def _count(items: Sequence | set) -> str:
    return f"{len(items)} frame{'' if len(items) == 1 else 's'}"


def _sorted(items: Sequence[int] | set[int]) -> tuple[int, ...]:
    return tuple(sorted(int(item) for item in items))


def _capped(score: float) -> float:
    return float(np.clip(score, 0.0, _CERTAIN))
