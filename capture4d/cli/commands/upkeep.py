"""`capture4d doctor`: what a report of a fault should bring along; `cache`: what is kept between runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.errors import CommandLineError

__all__ = ["Cache", "Doctor"]


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Tell whether this installation works: versions, parts, machine, cache folder; for reports of faults.

    Exit code 3 if something is missing or broken that commands need.
    """

    json: bool = False
    """Print JSON instead of text."""
    load: bool = True
    """Load every part, which takes some seconds; without it only versions are looked at."""

    def __call__(self) -> int:
        import json

        from capture4d.cli.installation import as_json, as_text, diagnose

        diagnosis = diagnose(load=self.load)
        print(json.dumps(as_json(diagnosis), indent=2) if self.json else as_text(diagnosis))
        for fault in diagnosis.faults:
            print(f"capture4d: {fault}", file=sys.stderr)
        return BAD_RESULT if diagnosis.faults else GOOD


@dataclass(frozen=True, kw_only=True)
class Cache:
    """Tell what the cache folder keeps, how large it is, and whether this version uses it; remove what is old.

    What is removed is made again when it is needed. Exit code 3 if something that was to go is still there.
    """

    remove: tuple[Annotated[str, arg(metavar="NAME")], ...] | None = None
    """Remove these entries: their names, or that of a folder of them (printed); old for all that is old, all for
    everything. What is being written stays."""
    dry_run: bool = False
    """Only tell what would be removed."""
    json: bool = False
    """Print JSON instead of text."""

    def __call__(self) -> int:
        import json

        from capture4d.app.cache_folder import removal, table
        from capture4d.app.cache_folder.contents import look
        from capture4d.cache import cache_path

        if self.remove == ():
            raise CommandLineError("--remove: expected old, all or names of entries, found none (see capture4d cache)")
        contents = look(cache_path())
        if self.remove is None or (not contents.entries and {*self.remove} <= {removal.OLD, removal.ALL}):
            print(
                json.dumps(table.as_json(contents), indent=2)
                if self.json
                else "\n".join(table.contents_lines(contents))
            )
            return GOOD
        entries = removal.chosen(contents, self.remove)
        done = removal.remove(contents, entries, dry_run=self.dry_run)
        if self.json:
            print(json.dumps(table.removal_as_json(done, dry_run=self.dry_run), indent=2))
        else:
            spared = (
                [] if removal.ALL not in self.remove else [each for each in contents.entries if each not in entries]
            )
            print("\n".join(table.removal_lines(done, spared, dry_run=self.dry_run)))
        return BAD_RESULT if done.left else GOOD
