"""What `--help` prints: the options that people need first; with `--help-all` those of the experts as well."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

from capture4d.cli.option_tree import Option, summary_of
from capture4d.cli.options import ClusterOptions, GradedOptions, MeshOptions, ProgressOptions, StageOptions

__all__ = ["EXAMPLES", "command_help", "filled", "overview"]

_WIDEST, _NARROWEST = 100, 40
_COLUMN = 26
"""Where the sentence about an option begins, counted from the margin."""
_SHARED = (StageOptions, ClusterOptions, GradedOptions, ProgressOptions, MeshOptions, object)
"""Whose options many commands have, in the order in which they are listed; help is nobody's."""
_GROUPS: Mapping[str, Sequence[str]] = {
    "from scans to a registered garment:": (
        "run", "check", "template", "extract", "track", "register", "report", "status", "diff", "view",
    ),
    "learn and animate:": (
        "fit", "fit-styles", "fit-style", "animate", "tryon", "wrinkles maps", "wrinkles train", "wrinkles apply",
        "wrinkles offsets", "compare", "offsets train", "offsets predict", "offsets draw", "offsets edit",
        "offsets apply",
    ),
    "out to other tools, and back:": ("texture", "export", "export-onnx", "import", "score"),
    "two meshes:": ("register-mesh",),
    "rigs:": ("calibrate", "check-rig", "convert-rig", "synth-board"),
    "captures that nobody filmed:": ("demo", "synth", "scan", "synth-drapes"),
    "files and this installation:": ("convert-body", "convert-poses", "doctor", "cache"),
}  # fmt: skip

EXAMPLES: Mapping[str, Sequence[str]] = {
    "demo": ("demo --output out",),
    "synth": (
        "synth take --preset tiny",
        "synth take --frames 60 --outfit red --scanner stereo",
        "synth take --print stripes",
        "synth take --preset trousers-200k --cut length=0.5 --motion.clip squat",
    ),
    "scan": ("scan meshes take --fps 30 --template template.obj",),
    "synth-board": ("synth-board capture/rig.json board --poses 16",),
    "synth-drapes": (
        "synth-drapes drapes --garment tshirt --samples 1000",
        "synth-drapes skirts --garment skirt --style length_m=0.6 flare=1.8 --beta 1.0 -0.5",
        "synth-drapes styles --preset tiny-styles",
    ),
    "check": ("check capture", "check scans --fps 60 --units mm --garment-colour '#2f62c9' --fix"),
    "template": (
        "template shirt.obj --units cm --output capture/template.npz",
        "template shirt.obj --wrap --cage panels.npy --output capture/template.npz",
        "template --region tshirt --output capture/template.npz",
    ),
    "extract": ("extract capture --output work",),
    "track": ("track capture --output work",),
    "register": ("register capture --output work", "register capture --output work --tracked --print print.png"),
    "run": (
        "run capture --output work",
        "run capture --output work --workers 8 --max-failed 2 --quiet",
        "run capture --output work --scheduler tcp://head:8786",
    ),
    "report": ("report work", "report work --fail-above fit_mean_mm=1.0 --fail-above frames_failed=0"),
    "status": ("status work", "status work --json"),
    "diff": ("diff before after", "diff before after --fail-if-worse fit_mean_mm=5"),
    "view": ("view work", "view capture", "view work --beside before --prepare"),
    "fit": ("fit work", "fit walk run jump --output shirt"),
    "fit-styles": ("fit-styles styles --output model", "fit-styles styles --output model --preset paper"),
    "fit-style": ("fit-style model work --output style.json",),
    "animate": (
        "animate work --poses motion.bvh --output dance --beta 1.5 2.0",
        "animate model --poses motion.bvh --output dance --style length=0.7",
        "animate model --poses motion.bvh --output dance --style @style.json",
    ),
    "tryon": ("tryon work --poses dance.bvh", "tryon model --wrinkles network"),
    "wrinkles maps": ("wrinkles maps work",),
    "wrinkles train": ("wrinkles train work --output model",),
    "wrinkles apply": ("wrinkles apply model work --bits 8 --flip-green",),
    "wrinkles offsets": ("wrinkles offsets work",),
    "offsets train": (
        "offsets train drapes --output model",
        "offsets train ties --output tie --preset necktie",
    ),
    "offsets predict": ("offsets predict model --poses motion.npz --output dance",),
    "offsets draw": ("offsets draw work --frame 12 --output pictures",),
    "offsets edit": ("offsets edit pictures operations.json work --output edited",),
    "offsets apply": ("offsets apply edited work --output edited.ply",),
    "compare": ("compare work --model model",),
    "texture": ("texture work --texels 2048",),
    "export": ("export work", "export dance --format glb --format abc --frames 1-200"),
    "export-onnx": ("export-onnx work/retarget", "export-onnx model --output wrinkles-onnx"),
    "import": ("import edited.abc --template work/registration/garment.npz --output edited",),
    "score": ("score edited capture --fail-above correspondence_mean_mm=3",),
    "register-mesh": ("register-mesh template.obj scan.ply --output fitted.ply --border-colour ffd200",),
    "calibrate": ("calibrate images --board charuco:14x10:60:44:DICT_5X5_100 --output rig.json",),
    "check-rig": ("check-rig rig.json images",),
    "convert-body": ("convert-body SMPL_NEUTRAL.pkl --output capture/body.npz",),
    "convert-rig": ("convert-rig sparse --output rig.json --scale 0.01",),
    "convert-poses": ("convert-poses walk.bvh poses.npz --up z",),
    "doctor": ("doctor", "doctor --json"),
    "cache": ("cache", "cache --remove old --dry-run", "cache --remove old", "cache --remove printed"),
}
"""Lines that work, where the files are there, without the `capture4d` before them."""


def command_help(name: str, kind: type, options: Sequence[Option], *, experts: bool) -> str:
    """The help of a command.

    Args:
        name: of the command, as it is typed.
        kind: its class.
        options: all of them.
        experts: whether those in settings inside settings are listed as well.
    """
    usage = " ".join(_in_usage(option) for option in options if option.is_positional)
    paragraphs = (kind.__doc__ or "").strip().split("\n\n")
    lines = [*_wrapped(f"usage: capture4d {name} [OPTIONS] {usage}"), ""]
    for paragraph in paragraphs:
        lines += [*_wrapped(" ".join(paragraph.split())), ""]
    arguments = [option for option in options if option.is_positional]
    if arguments:
        lines += ["arguments:", *_rows(arguments), ""]
    first = [*(option for option in options if not option.is_positional and not option.is_expert), _HELP]
    for title, group in _groups(first):
        lines += [*_wrapped(title), *_rows(group), ""]
    hidden = [option for option in options if option.is_expert]
    if experts:
        for title, group in _groups(hidden):
            lines += [*_wrapped(title), *_rows(group), ""]
    elif hidden:
        said = f"{len(hidden)} settings for experts are not shown; capture4d {name} --help-all lists them."
        lines += [*_wrapped(said), ""]
    examples = EXAMPLES.get(name, ())
    if examples:
        lines += ["examples:", *(f"  capture4d {line}" for line in examples)]
    return "\n".join(lines).rstrip()


def overview(commands: Mapping[str, type], group: str = "") -> str:
    """What there is to run, a line a command: of all, or of those whose name begins with `group`."""
    left = {name: command for name, command in commands.items() if name.startswith(group)}
    lines = [
        "usage: capture4d COMMAND ...",
        "",
        *_wrapped("4D garment capture: registration of coloured scans, learned garments, and a synthetic 4D scanner."),
        "",
    ]
    for title, names in {**_GROUPS, "more:": tuple(left)}.items():
        rows = {name: left.pop(name) for name in names if name in left}
        if rows:
            lines.append(title)
        for name, command in rows.items():
            lines += _row(name, f"{summary_of(command).partition('. ')[0].rstrip('.')}.", column=20)
        lines += [""] * bool(rows)
    lines += [
        *_wrapped(
            "capture4d COMMAND --help lists a command's options, capture4d help TOPIC explains; capture4d help lists "
            "the topics. Every command resumes where it was stopped."
        ),
    ]
    return "\n".join(lines)


def filled(text: str) -> str:
    """A paragraph in lines as wide as the terminal, and no wider than is good to read."""
    return "\n".join(_wrapped(" ".join(text.split())))


def _in_usage(option: Option) -> str:
    word = option.spelling if option.most == 1 else f"{option.spelling.removesuffix('...')}..."
    return word if option.is_required else f"[{word}]"


def _groups(options: Sequence[Option]) -> Iterator[tuple[str, list[Option]]]:
    """Options with a heading: the command's own, those of settings, those that many commands share."""

    own = [option for option in options if option.depth == 0 and option.owner not in _SHARED]
    if own:
        yield "options:", sorted(own, key=lambda option: not option.is_required)
    settings = (option for option in options if option.depth > 0)
    for (prefix, owner), group in groupby(settings, key=lambda option: (_prefix(option), option.owner)):
        yield f"{prefix or 'settings'}: {summary_of(owner)}", list(group)
    shared = [option for owner in _SHARED for option in options if option.owner is owner]
    if shared:
        yield "how it runs:", shared


def _prefix(option: Option) -> str:
    return option.spelling[2:].rpartition(".")[0]


def _rows(options: Iterable[Option]) -> list[str]:
    return [line for option in options for line in _row(_shown(option), _said(option))]


def _row(name: str, text: str, *, column: int = _COLUMN) -> list[str]:
    """A name and what is said of it beside it; below it where the name is long."""
    column = min(column, _width() // 2)
    lines = _wrapped(text, indent=" " * column)
    if len(name) + 4 <= column and lines:
        return [f"  {name}".ljust(column) + lines[0][column:], *lines[1:]]
    fits = len(name) + 2 <= _width()
    return [*_wrapped(name if fits else name.replace(",", ", "), indent="  "), *lines]


def _shown(option: Option) -> str:
    if option.is_positional:
        return option.spelling
    if option.kind is bool:
        return f"{option.spelling}, {option.negation}" if option.default is True else option.spelling
    return f"{option.spelling} {option.metavar}"


def _said(option: Option) -> str:
    if option.kind is bool and option.default is True:
        return f"{option.text} (default: {option.spelling})"
    if option.is_required:
        return f"{option.text} (required)"
    shown = _value(option.default)
    return f"{option.text} (default: {shown})" if shown else option.text


def _value(value: Any) -> str:
    """A default as it would be typed; empty for one that is nothing."""
    if value is None or isinstance(value, bool):
        return ""
    if isinstance(value, tuple):
        return " ".join(map(_value, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _wrapped(text: str, *, indent: str = "") -> list[str]:
    return textwrap.wrap(
        text,
        _width(),
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
    )


def _width() -> int:
    return max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size((_WIDEST, 24)).columns))


_HELP = Option(
    spelling="--help",
    is_positional=False,
    kind=bool,
    fewest=0,
    most=0,
    metavar="",
    default=False,
    text="Print this. --help-all tells of every setting.",
    owner=object,
    depth=0,
)
