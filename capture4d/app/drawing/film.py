"""Films: frames one after the other, which show the flicker and the sliding that stills hide."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from capture4d.app.drawing.page import Film
from capture4d.app.drawing.panels import WEBP, data_uri
from capture4d.types import Mesh

__all__ = ["checks", "make_film", "rows_around", "tiled"]

CHECK_M = 0.05
"""Edge of a check, metres at rest: three to four edges of a template of 5,000 vertices."""
LIGHT, DARK = (214, 221, 231), (96, 122, 166)
LEAST_MS = 40
"""Nobody sees more than 25 pictures a second."""
QUALITY = 78


def checks(template: Mesh) -> UInt8[np.ndarray, "verts 3"]:
    """Colours that stay with the cloth: checks of the template at rest. Where it slides, they slide over the folds."""
    cells = np.floor(template.vertices.astype(float) / CHECK_M + 1e-6).astype(np.int64).sum(axis=1)
    return np.where((cells % 2 == 0)[:, None], np.array(LIGHT, np.uint8), np.array(DARK, np.uint8))


def rows_around(total: int, count: int, worst: int) -> range:
    """`count` consecutive positions among `total`, the worst in their middle if there is room; or all."""
    count = min(total, count)
    start = min(max(worst - count // 2, 0), total - count)
    return range(start, start + count)


def tiled(pictures: Sequence[Sequence[UInt8[np.ndarray, "height width 3"]]]) -> UInt8[np.ndarray, "rows columns 3"]:
    """Rows of pictures of one size as one."""
    return np.concatenate([np.concatenate(list(row), axis=1) for row in pictures])


def make_film(
    title: str,
    pictures: Sequence[UInt8[np.ndarray, "height width 3"]],
    captions: Sequence[str],
    *,
    seconds: float,
    note: str,
) -> Film:
    """Pictures of one size, at least one, as an animation and one by one.

    Args:
        captions: of each picture, beside the slider.
        seconds: from one to the next in the take; the film is slower where that is too fast to see.
        note: what it shows.
    """
    first, *others = [Image.fromarray(picture) for picture in pictures]
    buffer = io.BytesIO()
    first.save(
        buffer, "WEBP", save_all=True, append_images=others, duration=max(LEAST_MS, round(1e3 * seconds)), loop=0,
        quality=QUALITY, method=3,
    )  # fmt: skip
    moving = WEBP + base64.b64encode(buffer.getvalue()).decode()
    return Film(title, moving, [data_uri(picture) for picture in pictures], captions, note)
