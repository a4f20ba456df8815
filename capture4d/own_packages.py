"""Four packages beside `capture4d` have common names: a `registration.py` of the user's own must not stand for ours.

`python -m` and scripts search the current folder first, so their `registration.py` would be imported in our place. The
finder below answers for those four names alone.
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

__all__ = ["OWN", "claim_names"]

OWN = ("data_synth", "registration", "retarget", "wrinkles")
_ROOT = Path(__file__).resolve().parents[1]


def claim_names() -> None:
    """From now on the four names mean ours. Others of that name that were loaded before stay with who loaded them."""
    for name in OWN:
        loaded = sys.modules.get(name)
        if loaded is not None and not _is_ours(loaded):
            for each in [each for each in sys.modules if each == name or each.startswith(f"{name}.")]:
                del sys.modules[each]
    if not any(isinstance(finder, type) and finder.__name__ == _OwnPackages.__name__ for finder in sys.meta_path):
        sys.meta_path.insert(0, _OwnPackages)


class _OwnPackages:
    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name not in OWN:
            return None
        theirs = PathFinder.find_spec(name)
        if theirs is not None and theirs.origin is not None and _asks_for_neighbour(Path(theirs.origin)):
            raise ImportError(
                f"{theirs.origin}: expected another name, for capture4d has a package '{name}'; rename the file, or "
                f"import it before capture4d"
            )
        return PathFinder.find_spec(name, [str(_ROOT)])


def _is_ours(module: ModuleType) -> bool:
    origin = getattr(module, "__file__", None)
    return origin is not None and Path(origin).resolve().is_relative_to(_ROOT / module.__name__)


def _asks_for_neighbour(origin: Path) -> bool:
    """Whether the code that imports lies beside a file of that name that is not ours, and so means that one."""
    folder = (origin.parents[1] if origin.name == "__init__.py" else origin.parent).resolve()
    if folder == _ROOT:
        return False
    # inspect has a public name for it, and would cost every command its import
    frame = sys._getframe(1)  # pyright: ignore[reportPrivateUsage]
    while frame is not None and frame.f_code.co_filename.startswith(("<frozen", __file__)):
        frame = frame.f_back
    return frame is not None and Path(frame.f_code.co_filename).resolve().parent == folder
