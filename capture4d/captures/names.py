"""Names from files: of takes, of borders, of cameras. They are shown to people, and some become names of files."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping

from capture4d.errors import InputError

__all__ = ["require_plain_names", "require_text", "telling_names", "unknown_borders"]

LONGEST = 100
"""Characters; a file system's limit is 255 bytes, and endings come behind."""
_RESERVED = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?", re.IGNORECASE)
"""What Windows takes for a device, with any ending."""
_NAMELESS = re.compile(r"border|paint_[0-9]+")
"""What capture4d itself calls a paint of which it does not know which border wears it."""
_SEPARATORS = '/\\:*?"<>|'


def require_text(text: object, what: str) -> str:
    """A text to be shown.

    Raises:
        InputError: it is no text, is empty, longer than any name, or has control characters in it.
    """
    if not isinstance(text, str):
        raise InputError(f"{what}: expected text, found {_shown(text)}")
    if not text.strip() or len(text) > LONGEST:
        raise InputError(f"{what}: expected 1 to {LONGEST} characters, found {len(text)}")
    if any(unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") for letter in text):
        raise InputError(f"{what}: expected text without control characters, found {text!a}")
    return text


def require_plain_names(names: Iterable[object], what: str) -> None:
    """See that each can be part of a file's name, on any system, and leads nowhere.

    Args:
        what: they are names of, as in "border".
    Raises:
        InputError: one cannot.
    """
    for name in names:
        text = require_text(name, f"name of a {what}")
        leads = text != text.strip() or text.startswith(".") or text.endswith(".") or _RESERVED.fullmatch(text)
        if leads or any(letter in _SEPARATORS for letter in text):
            raise InputError(f"name of a {what}: expected one that can be a file's on any system, found {text!a}")


def unknown_borders(painted: Iterable[str], loops: Iterable[str]) -> tuple[str, ...]:
    """Borders after which paints are named and which a template does not have, in order.

    `border` and `paint_0`, which `check --fix` and `extract` write where no template tells them better, name none: such
    a paint may be on any border.

    Args:
        painted: names of the paints that tell their border, as `telling_names` has them.
    """
    return tuple(sorted(name for name in {*painted} - {*loops} if not _NAMELESS.fullmatch(name)))


def telling_names(paints: Mapping[str, Hashable]) -> list[str]:
    """Names of the borders whose paint no other border wears: a paint on several does not tell them apart."""
    worn = Counter(paints.values())
    return [name for name, paint in paints.items() if worn[paint] == 1]


def _shown(value: object) -> str:
    said = ascii(value)
    return said if len(said) <= 60 else f"{said[:57]}..."
