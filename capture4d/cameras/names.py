"""Names of cameras, from the images that a file of somebody else's lists."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath

from capture4d.errors import InputError

__all__ = ["camera_names"]

_ENDING = re.compile(r"(?<=[^/])\.[A-Za-z][A-Za-z0-9]{0,4}$")
"""Of an image file; `.01` belongs to a name."""


def camera_names(images: Sequence[str], *, by_folder: bool = False) -> tuple[str, ...]:
    """File names without their endings, or folders; where these are not unique, paths with underscores for separators.

    Raises:
        InputError: two images have the same name.
    """
    twice = [image for image, count in Counter(images).items() if count > 1]
    if twice:
        raise InputError(f"expected images with different names, found {twice[0]!a} twice")
    whole = ["_".join(_parts(image)) for image in images]
    bare = ["_".join(_parts(_ENDING.sub("", image))) for image in images]
    short = [PurePosixPath("/".join(_parts(_ENDING.sub("", image)))).name for image in images]
    folders = [(_parts(image)[:-1] or [name])[-1] for image, name in zip(images, short, strict=True)]
    for names in (folders if by_folder else short, bare, whole):
        if len(set(names)) == len(names):
            return tuple(names)
    raise InputError("expected images whose paths differ in more than separators, found the same twice")


def _parts(path: str) -> list[str]:
    return [part for part in path.replace("\\", "/").split("/") if part not in ("", ".")] or [""]
