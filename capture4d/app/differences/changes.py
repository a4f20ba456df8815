"""What changed from one work folder to another: settings and inputs in words, metrics by their better direction."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from capture4d.app.differences.sides import Side
from capture4d.app.report.animation import ANIMATION_METRICS
from capture4d.app.report.animation import summarise as summarise_animation
from capture4d.app.report.metrics import METRICS, column, shown, summarise
from capture4d.files.reading import shortened
from capture4d.runs.changes import description_changes

__all__ = ["MetricChange", "SettingChange", "metric_changes", "setting_changes"]

STAGES = {"garment": "extract", "body": "track", "registration": "register", "retarget": "fit"}
"""Folders whose settings decide the results, and what their stages are called where they do not say themselves."""
INPUTS: Mapping[str, tuple[str, str]] = {
    "capture": ("other scans, or another description of them", "the scans of a capture"),
    "garment": ("other extracted garments", "extracted garments"),
    "template": ("another template", "a template"),
    "motion": ("other poses of the capture", "the poses of the capture"),
    "body": ("another body", "a body of its own"),
    "start": ("another pose to start from", "a pose to start from"),
    "loops": ("other border loops", "the template's border loops"),
    "model": ("another learned garment", "a learned garment"),
    "poses": ("another motion", "a motion"),
}
"""What a stage is made from, by its name in stage.json: as it is said where it is another one, and where only one of
two folders has it."""
TRACKED = ("another tracked body", "the tracked body")
"""The body, where a registration was made from it."""
_LONGEST = 60


# --- settings and inputs -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SettingChange:
    """A setting, or an input, of a stage that is not the same in both folders."""

    stage: str
    kind: Literal["setting", "input", "description", "stage"]
    name: str
    before: str | None
    """None where the first folder has nothing of the kind, or the name says all."""
    after: str | None

    @property
    def words(self) -> str:
        """In a line, without the folders' names."""
        if self.kind == "stage":
            return f"{self.stage}: was {self.before or 'not done'}, now {self.after or 'not done'}"
        if self.kind == "description":
            return f"{self.stage}: {self.name}"
        if self.kind == "input":
            made = "no longer made" if self.after is None else "now made" if self.before is None else "made"
            return f"{self.stage}: {made} from {self.name}"
        return f"{self.stage}: {self.name} was {self.before or 'not there'}, now {self.after or 'not there'}"


def setting_changes(before: Side, after: Side) -> list[SettingChange]:
    """Every difference in what the two were made with and from, stage by stage."""
    changes = []
    for folder, stage in STAGES.items():
        one, other = (side.work.stages.get(folder) for side in (before, after))
        if one is None or other is None or one.get("stage") != other.get("stage"):
            told = [None if record is None else _state(record, stage) for record in (one, other)]
            if told[0] != told[1]:
                changes.append(SettingChange(stage, "stage", "", *told))
            continue
        changes += _stage_changes(str(other["stage"]), one, other)
    return changes


def _state(record: Mapping[str, Any], stage: str) -> str:
    made_by = "" if record["stage"] == stage else f" by '{record['stage']}'"
    return f"{'done' if record.get('status') == 'complete' else 'unfinished'}{made_by}"


def _stage_changes(stage: str, one: Mapping[str, Any], other: Mapping[str, Any]) -> Iterator[SettingChange]:
    states = (_state(one, stage), _state(other, stage))
    if states[0] != states[1]:
        yield SettingChange(stage, "stage", "", *states)
    if one.get("schema") != other.get("schema"):
        yield SettingChange(stage, "setting", "format of the output", f"{one.get('schema')}", f"{other.get('schema')}")
    made = [record.get("upstream", {}) for record in (one, other)]
    for name in dict.fromkeys((*made[0], *made[1])):
        if name != "regressor" and made[0].get(name) != made[1].get(name):  # a part of the model
            another, the = (
                TRACKED if (stage, name) == ("register", "body") else INPUTS.get(name, (f"another {name}", name))
            )
            told = another if name in made[0] and name in made[1] else the
            yield SettingChange(stage, "input", told, *(_digest(record.get(name)) for record in made))
    for words in description_changes(other.get("description", {}), one.get("description", {})):
        yield SettingChange(stage, "description", words, None, None)
    said = [dict(_flat(record.get("config"))) for record in (one, other)]
    for name in dict.fromkeys((*said[0], *said[1])):
        if name != "schema" and said[0].get(name) != said[1].get(name):
            yield SettingChange(stage, "setting", name, said[0].get(name), said[1].get(name))


def _digest(digest: Any) -> str | None:
    return None if digest is None else str(digest)[:8]


def _flat(value: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Settings by their dotted names, as they are written in commands."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _flat(entry, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, shortened(value if isinstance(value, str) else json.dumps(value), _LONGEST)


# --- metrics -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MetricChange:
    """A metric of both folders."""

    key: str
    before: float | None
    after: float | None
    over_all: bool = False
    """Each figure is over all frames of its folder, for nobody kept it frame by frame."""

    @property
    def unit(self) -> str:
        return _known(self.key)[0]

    @property
    def better(self) -> str:
        return _known(self.key)[1]

    @property
    def meaning(self) -> str:
        """A whole one: what "the same" is in a table, by the last row above that says it, is said."""
        told = _known(self.key)[2]
        table = METRICS if self.key in METRICS else ANIMATION_METRICS
        above = [each[2] for each in list(table.values())[: list(table).index(self.key)]]
        whole = next((each for each in reversed(above) if not each.startswith("the same")), "")
        return told.replace("the same", whole, 1) if told.startswith("the same") else told

    @property
    def delta(self) -> float | None:
        return None if self.before is None or self.after is None else self.after - self.before

    @property
    def verdict(self) -> Literal["better", "worse", "same", "unknown"]:
        """Of the second folder. Figures that print alike are the same."""
        if self.before is None or self.after is None:
            return "unknown"
        if shown(self.before) == shown(self.after):
            return "same"
        return "worse" if (self.after > self.before) == (self.better == "lower") else "better"

    @property
    def worse_percent(self) -> float:
        """How much worse the second is, in percent of the first; negative where it is better.

        Infinite where the first is 0 and the second worse, or where one of them was not measured.
        """
        if self.before is None or self.after is None:
            return math.inf
        loss = self.after - self.before if self.better == "lower" else self.before - self.after
        return 100 * loss / abs(self.before) if self.before else math.copysign(math.inf, loss) if loss else 0.0

    @property
    def change(self) -> str:
        """The difference as tables print it."""
        if self.verdict == "same":
            return "same"
        if self.delta is None or self.before is None:
            return "–"
        sign = "+" if self.delta > 0 else "−"
        known = self.before and self.unit != "%"  # percent of percent would be misread
        share = f" ({sign}{_percent(abs(100 * self.delta / self.before))} %)" if known else ""
        return f"{sign}{shown(abs(self.delta))}{share}"


def _percent(value: float) -> str:
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}" if value >= 0.095 else f"{value:.2g}"


def metric_changes(before: Side, after: Side) -> list[MetricChange]:
    """The metrics that either folder has. Means are over the frames that both have measured, so that frames which
    are missing in one, or failed there, make it neither better nor worse; without a common frame, over all of each."""
    pair = _comparable(before.records, after.records)
    one, other = (_summary(side, records) for side, records in zip((before, after), pair, strict=True))
    changes = []
    for key in dict.fromkeys((*METRICS, *ANIMATION_METRICS)):
        figures, over_all = (one.get(key), other.get(key)), False
        if figures == (None, None):
            figures, over_all = (before.reported.get(key), after.reported.get(key)), True
        if figures != (None, None):
            changes.append(MetricChange(key, *figures, over_all=over_all and len(before.records) > 0))
    return changes


def _known(key: str) -> tuple[str, str, str]:
    return METRICS[key] if key in METRICS else ANIMATION_METRICS[key]


def _comparable(
    one: Mapping[int, Mapping[str, Any]], other: Mapping[int, Mapping[str, Any]]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Records of the frames that both have; a measure that both have somewhere is left out where one has none."""
    numbers = sorted(set(one) & set(other))
    if not numbers:
        return [dict(one[number]) for number in sorted(one)], [dict(other[number]) for number in sorted(other)]
    pair = ([dict(one[number]) for number in numbers], [dict(other[number]) for number in numbers])
    keys = {
        key
        for key in (*METRICS, *ANIMATION_METRICS)
        if all(any(_is_finite(each.get(key)) for each in side) for side in pair)
    }
    for first, second in zip(*pair, strict=True):
        for key in keys:
            if not (_is_finite(first.get(key)) and _is_finite(second.get(key))):
                first[key] = second[key] = None
    return pair


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _summary(side: Side, records: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """The metrics of some frames, as the report of such a folder has them."""
    if not records:
        return {}
    found: dict[str, float | None] = {}
    if side.kind == "registered":
        found = summarise(records)
    elif side.kind == "animated":
        found = dict(summarise_animation(records))
        found |= {key: _figure(np.mean, records, key) for key in ANIMATION_METRICS if key in records[0]}
    tracked = [record for record in records if record.get("track_verdict") is not None]
    if tracked:
        good = sum(record["track_verdict"] == "good" for record in tracked)
        found["track_good_percent"] = 100 * good / len(tracked)
        found |= {key: _figure(np.mean, tracked, key) for key in ("track_median_mm", "joint_mean_mm", "joint_max_mm")}
        found["track_cpu_s"] = _figure(np.median, tracked, "track_cpu_s")
    return {key: value if _is_finite(value) else None for key, value in found.items()}


def _figure(statistic: Any, records: Sequence[Mapping[str, Any]], key: str) -> float | None:
    values = column(records, key)
    values = values[np.isfinite(values)]
    return float(statistic(values)) if len(values) else None
