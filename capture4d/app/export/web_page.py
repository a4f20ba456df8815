"""One HTML file that shows the garment in any browser, from disk, without a network: three.js, a GLB and its maps."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
from PIL import Image

from capture4d.app.export.clip import Clip
from capture4d.app.export.maps import map_bytes
from capture4d.errors import InputError
from capture4d.files.atomic import write_chunks
from capture4d.files.pictures import picture_pixels

__all__ = ["require_page", "write_page"]

_QUALITY = 90
"""Of WebP: 1.3 degrees of a normal in the mean, at an eighth of a PNG's size (docs/notebook/export.md)."""
_LOST = 8
"""Levels of 255 that WebP may change in the mean: it halves the colours' resolution, which a small map feels."""
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src blob: data:; "
    "connect-src blob: data:"
)
"""Nothing may be loaded from anywhere."""
_HEAD = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>capture4d</title>
<meta http-equiv="Content-Security-Policy" content="{policy}">
<style>
body {{ margin: 0; font: 14px system-ui, sans-serif; background: #e8e8ea; overflow: hidden }}
#bar {{ height: 48px; display: flex; gap: 12px; align-items: center; padding: 0 16px }}
#frame {{ flex: 1 }}
#label {{ min-width: 7em }}
button {{ width: 5em }}
canvas {{ display: block }}
</style>
<div id="view"></div>
<div id="bar">
<button id="play">play</button><input id="frame" type="range" min="0" value="0" aria-label="frame">
<span id="label"></span><label><input id="wrinkles" type="checkbox" checked> wrinkles</label>
</div>
<!-- three.js {three} -->
<script id="take" type="application/json">"""
_TAIL = "</script>\n</html>\n"


def write_page(path: Path, glb: Path, clip: Clip) -> None:
    """Write the page.

    Args:
        glb: the garment as `export --format glb` writes it.
    """
    viewer = files("capture4d.app.export").joinpath("viewer")
    licence = " ".join(viewer.joinpath("LICENSE-three.txt").read_text(encoding="utf-8").split())
    script = viewer.joinpath("viewer.min.js").read_text(encoding="utf-8").replace("</script", "<\\/script")

    def chunks() -> Iterator[bytes]:
        yield _HEAD.format(policy=_POLICY, three=licence.replace("--", "- ")).encode()
        ids = clip.moving.frame_ids.tolist()
        yield b'{"fps":%s,"frames":%s,"glb":"' % (json.dumps(clip.moving.fps).encode(), json.dumps(ids).encode())
        yield base64.b64encode(glb.read_bytes())
        yield b'","maps":['
        for at, frame_id in enumerate(ids if clip.maps is not None else []):
            assert clip.maps is not None
            yield b',"' if at else b'"'
            yield base64.b64encode(_webp(map_bytes(clip.maps, frame_id, 8)))
            yield b'"'
        yield b"]}</script>\n<script type=module>" + script.encode() + _TAIL.encode()

    write_chunks(path, chunks())


def _webp(png: bytes) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture_pixels(png)).save(buffer, "WEBP", quality=_QUALITY)
    return buffer.getvalue()


def require_page(path: Path, glb: Path, clip: Clip) -> None:
    """See that a page holds what it should: the very GLB, frames, and a picture of each map's size.

    Raises:
        InputError: it does not.
    """
    text = path.read_text(encoding="utf-8")
    found = re.search(r'<script id="take" type="application/json">(.*?)</script>', text, re.DOTALL)
    take = json.loads(found[1]) if found else {}
    ids = clip.moving.frame_ids.tolist()
    if take.get("frames") != ids or base64.b64decode(take.get("glb", "")) != glb.read_bytes():
        raise InputError("read back: expected the frames and the GLB that were written, found others", where=path)
    if len(take["maps"]) != (len(ids) if clip.maps is not None else 0):
        raise InputError(f"read back: expected a map for each frame, found {len(take['maps'])}", where=path)
    for frame_id, each in zip(ids, take["maps"], strict=False):
        assert clip.maps is not None
        wanted = picture_pixels(map_bytes(clip.maps, frame_id, 8)).astype(np.int16)
        pixels = picture_pixels(base64.b64decode(each)).astype(np.int16)
        if pixels.shape != wanted.shape or np.abs(pixels - wanted).mean() > _LOST:
            raise InputError(f"read back: expected the map of frame {frame_id}, found another picture", where=path)
