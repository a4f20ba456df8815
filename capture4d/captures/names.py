"""Names from files: of takes, of borders, of cameras. They are shown to people, and some become names of files."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

from capture4d.errors import InputError

__all__ = ["require_plain_names", "require_text"]

LONGEST = 100
"""Characters; a file system's limit is 255 bytes, and endings come behind."""
_RESERVED = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?", re.IGNORECASE)
"""What Windows takes for a device, with any ending."""
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


def _shown(value: object) -> str:
    said = ascii(value)
    return said if len(said) <= 60 else f"{said[:57]}..."
