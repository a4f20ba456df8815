"""What was made lately, up to so many bytes: a take of any length is looked through in bounded memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

__all__ = ["Kept"]

Value = TypeVar("Value")


class Kept(Generic[Value]):
    """Values by key, of which those that were not asked for longest are let go first. For several threads.

    Args:
        most_bytes: that are kept; a value that is larger is handed on and not kept.
        size: of a value, bytes.
    """

    def __init__(self, most_bytes: int, size: Callable[[Value], int]) -> None:
        self._most, self._size, self._total = most_bytes, size, 0
        self._values: OrderedDict[Hashable, tuple[Value, int]] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        return self._total

    def __contains__(self, key: Hashable) -> bool:
        return key in self._values

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key; made, while others may be asked for, if it is not there."""
        with self._lock:
            found = self._values.get(key)
            if found is not None:
                self._values.move_to_end(key)
                return found[0]
        value = make()
        size = self._size(value)
        with self._lock:
            if key not in self._values and size <= self._most:
                self._values[key] = value, size
                self._total += size
            while self._total > self._most:
                _, (_, gone) = self._values.popitem(last=False)
                self._total -= gone
        return value

    def clear(self) -> None:
        with self._lock:
            self._values.clear()
            self._total = 0
