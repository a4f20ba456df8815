"""JSON from strangers: a name once, numbers that are finite and numbers, and no deeper than it needs to be."""

from __future__ import annotations

import json
import math
from typing import Any

from capture4d.errors import InputError
from capture4d.files.reading import one_line, shortened

__all__ = ["entry", "json_value", "number", "text", "texts", "whole", "wholes"]


def json_value(data: str | bytes) -> Any:
    """What a text says.

    Raises:
        InputError: it is no JSON, or says NaN, infinity, or a name twice in one object; the message names no file.
    """
    try:
        if not isinstance(data, str):
            data = data.decode(json.detect_encoding(data))
        return json.loads(data, object_pairs_hook=_once, parse_float=_finite, parse_constant=_refused)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"not valid JSON ({one_line(error)})") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"expected every name once, found {shortened(repr(twice), 80)} again")
    return found


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise InputError(f"expected finite numbers, found {text[:40]}")
    return value


def _refused(text: str) -> Any:
    raise InputError(f"expected finite numbers, found {text}, which is no JSON")


# --- values of a kind ------------------------------------------------------------------------------------------------


def entry(tree: Any, name: str) -> Any:
    """An entry of an object."""
    if not isinstance(tree, dict):
        raise InputError(f"expected an object with '{name}', found {_told(tree)}")
    if name not in tree:
        raise InputError(f"expected the entry '{name}', found none")
    return tree[name]


def number(value: Any, name: str) -> float:
    """A finite number; true and "1" are none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name}: expected a number, found {_told(value)}")
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise InputError(f"{name}: expected a finite number, found {_told(value)}")
    return found


def whole(value: Any, name: str, *, least: int = 0, most: int = 2**31 - 1) -> int:
    """A whole number of a range; 3.0 is one."""
    found = number(value, name)
    if not found.is_integer() or not least <= found <= most:
        raise InputError(f"{name}: expected a whole number from {least} to {most}, found {_told(value)}")
    return int(found)


def wholes(value: Any, name: str, *, least: int = 0) -> tuple[int, ...]:
    return tuple(whole(each, name, least=least) for each in _listed(value, name))


def text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"{name}: expected text, found {_told(value)}")
    return value


def texts(value: Any, name: str) -> tuple[str, ...]:
    return tuple(text(each, name) for each in _listed(value, name))


def _listed(value: Any, name: str) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{name}: expected a list, found {_told(value)}")
    return value


def _told(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    kinds = {dict: "an object", list: "a list"}
    return kinds.get(type(value)) or shortened(" ".join(json.dumps(value).split()), 80)
