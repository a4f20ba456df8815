"""One look for every page: what the templates are filled with, and how they become one file of HTML.

A page's own template, beside the module that fills it, starts from the shared skeleton and takes its parts from the
shared macros:

    {% extends "page.html.jinja" %}
    {% import "parts.html.jinja" as parts %}
    {% block content %}
      {{ parts.tiles(tiles) }}
      <h2>Frames</h2>
      {{ parts.table(flagged) }}
    {% endblock %}

A page is self-contained: styles, pictures and the few lines of script that move a film are inside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import jinja2

__all__ = ["Badge", "Chart", "Column", "Film", "Table", "Tile", "render_page"]

SHARED = "capture4d.app.drawing"
"""Where the skeleton and the macros lie."""


@dataclass(frozen=True, slots=True)
class Tile:
    """A figure that matters, large."""

    value: str
    unit: str
    name: str


@dataclass(frozen=True, slots=True)
class Badge:
    """A word on a coloured ground: a verdict, a severity."""

    text: str
    kind: str = ""
    """good, check or failed; if empty, what `KINDS` says of the text, or grey."""

    @property
    def colour(self) -> str:
        """The class of its colour."""
        return self.kind or KINDS.get(self.text, "")


KINDS: Mapping[str, str] = {
    "good": "good",
    "check": "check",
    "failed": "failed",
    "lost": "failed",
    "error": "failed",
    "errors": "failed",
    "worse": "failed",
    "moved": "failed",
    "warning": "check",
    "warnings": "check",
    "unseen": "check",
    "clean": "good",
    "better": "good",
}
"""Words that mean one of the three verdicts."""


@dataclass(frozen=True, slots=True)
class Column:
    """The head of a table's column."""

    name: str
    number: bool = False
    """Set flush right."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of texts and badges."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[str | Badge]]
    stacks: bool = False
    """On a narrow screen each row becomes a block of lines with their heads; else the table scrolls sideways."""


@dataclass(frozen=True, slots=True)
class Chart:
    """Curves under a title."""

    title: str
    svg: str


@dataclass(frozen=True, slots=True)
class Film:
    """Frames one after the other: an animation that plays by itself, and a slider to stop at any of them."""

    title: str
    moving: str
    """The animated picture, a data URI; shown alone where scripts are off."""
    stills: Sequence[str]
    """Each frame as a data URI."""
    captions: Sequence[str]
    """What is said of each frame beside the slider."""
    note: str = ""


def render_page(package: str, template: str, **values: Any) -> str:
    """The HTML of a page.

    Args:
        package: where the page's template lies, such as "capture4d.app.compare".
        template: its file name.
        values: what it shows; texts are escaped. `title` is the page's.
    """
    places = [jinja2.PackageLoader(name, ".") for name in dict.fromkeys((package, SHARED))]
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(places), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template(template).render(version=version("capture4d"), **values)
