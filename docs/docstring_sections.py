"""Our docstrings put no empty line between their sections; the parser of the site wants one."""

import re

import griffe

_SECTION = re.compile(r"\n+(?=\s*(Args|Attributes|Raises|Returns|References|Yields):)")


class SpacedSections(griffe.Extension):
    """An empty line before each section, while the site is built."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        if obj.docstring:
            obj.docstring.value = _SECTION.sub("\n\n", obj.docstring.value)
