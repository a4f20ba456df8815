"""`capture4d doctor`: what a report of a fault should bring along."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from capture4d.cli.exit_codes import BAD_RESULT, GOOD

__all__ = ["Doctor"]


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
