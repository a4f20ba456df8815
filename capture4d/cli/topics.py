"""What `capture4d help TOPIC` prints: short texts, each with the page of docs/ that has the rest."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from capture4d.cli.help_text import filled

__all__ = ["TOPICS", "Topic", "list_of_topics", "topic_text"]

_STANDS = re.compile(r"\S  +\S|^capture4d ", re.MULTILINE)
"""What tells a paragraph whose lines are meant."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One text."""

    title: str
    page: str
    """Below docs/."""
    text: str
    """Paragraphs. Those with columns, and lines to type, are printed as they stand; others are filled."""


TOPICS: Mapping[str, Topic] = {
    "getting-started": Topic(
        "From nothing to a report",
        "tutorial/own-scans.md",
        """\
capture4d demo --output out          # simulates a take, scans it and does everything, in minutes
capture4d check capture              # your own take, before a night is spent on it
capture4d run capture --output work  # extract, track, register, report

Open work/report/index.html. Where frames are flagged, the last lines on the screen say which.
The same command goes on where it was stopped. `capture4d help own-scans` says how to bring a take.""",
    ),
    "own-scans": Topic(
        "Your own scans as a capture folder",
        "tutorial/own-scans.md#write-a-capture-folder",
        """\
capture/
  capture.json      {"format": 1, "name": "take-01", "fps": 60, "units": "mm"}
  scans/000123.ply  one mesh with vertex colours a frame: ply, obj, glb, gltf, stl or off
  poses.npz         the body's motion (optional: without it the body is tracked)
  template.npz      the garment to register; `capture4d template` makes one, or template.obj

Scans that are named otherwise, units and colours: `capture4d check FOLDER` finds out most of it,
takes what you know (--pattern, --fps, --units, --garment-colour) and with --fix writes a capture.""",
    ),
    "captures": Topic(
        "What is in CAPTURE and WORK",
        "reference/files.md",
        """\
CAPTURE is what was filmed, and is never written to. WORK is what commands make of it, a folder a stage:

garment/        extract: the garment of each scan and its painted border
body/           track: poses and one shape
registration/   register: the template in every frame; vertices.npy, metrics.jsonl
retarget/       fit: the learned garment
report/         report: index.html, metrics.json
log.jsonl       every command that ran here, for reports of faults

Each stage has a stage.json: its settings, and the digests of what it was made from.""",
    ),
    "check": Topic(
        "Whether a take is worth a night",
        "how-to/check-a-take.md",
        """\
capture4d check capture            # a sample of the frames, in seconds
capture4d check capture --all      # every frame
capture4d check capture --fix      # a corrected take, capture-fixed; the original is only read
capture4d check scans --fps 60 --units mm --pattern "take_{frame}.obj"

It finds wrong units and axes, mirrored scans, wrong frame rates and colours, damaged and missing frames;
each finding says what to do. Errors end in exit code 3, with --strict warnings do too.""",
    ),
    "template": Topic(
        "The garment that is registered",
        "how-to/make-a-template.md",
        """\
capture4d template shirt.obj --units cm --output capture/template.npz  # a mesh on the body
capture4d template --region tshirt --output capture/template.npz       # a part of the body

It is bound to the body, its open borders are named, and its UVs are checked or cut afresh. A mesh that
lies on a posed or shaped person needs --poses, and --body if that is not the built-in one.""",
    ),
    "tracking": Topic(
        "The body in the scans",
        "methods/tracking.md",
        """\
`run` tracks by itself where the capture has no poses.npz; --tracked tracks all the same.

capture4d track capture --output work
capture4d register capture --output work --tracked

A take that does not begin in a pose that the search finds: --tracking.start rest, or --tracking.start
poses.npz with a pose to begin from. Frames that are lost are filled in between, and flagged.""",
    ),
    "registration": Topic(
        "The template in every frame",
        "methods/registration.md",
        """\
capture4d register capture --output work                   # the default, fast
capture4d register capture --output work --preset paper    # DeepWrinkles as printed

A frame is good, to check, or failed. Fit is the mean distance of template and scan, border that of the
template's border and the paint, both in millimetres. Limits: --registration.quality.fit-check-mm and
its neighbours. Settings are the same in `run` and `register`: capture4d register --help-all.""",
    ),
    "retarget": Topic(
        "The garment learned, on other motions and people",
        "tutorial/learn-and-move.md",
        """\
capture4d fit work                                               # writes work/retarget
capture4d animate work --poses motion.bvh --output dance         # the captured person
capture4d animate work --poses motion.bvh --output dance --beta 1.5 2.0
capture4d report dance

Motions: poses.npz, AMASS and other SMPL files, BVH; `capture4d convert-poses` turns one into another.
A pose that is unlike everything learned is flagged.""",
    ),
    "wrinkles": Topic(
        "Normal maps with wrinkles",
        "how-to/add-wrinkles.md",
        """\
capture4d wrinkles train work --output model     # makes the take's maps, learns from them
capture4d wrinkles apply model dance             # PNG files in dance/wrinkles/generated/frames
capture4d wrinkles apply model dance --bits 8 --flip-green      # for DirectX and Unreal
capture4d compare work --model model             # how good it is, on frames kept from it""",
    ),
    "resume": Topic(
        "When a run is stopped",
        "how-to/when-it-stops.md",
        """\
Kill it, pull the plug, fill the disk: the same command goes on with what is missing, and the result is
that of a run without a stop. Files are there whole or not at all.

Other settings are refused, never mixed: --overwrite starts clean. So leave --overwrite out when you run
a stopped command again; with it, all begins anew. --wait waits for another command on the same folder.
work/log.jsonl has what was run, what was said and what went wrong.""",
    ),
    "progress": Topic(
        "What is shown meanwhile",
        "reference/progress.md",
        """\
On a terminal a bar; elsewhere, such as in a log file, a line every ten seconds, the first at once.

--quiet            verdicts and faults alone
--json-progress    one JSON object a line on stderr, for machines""",
    ),
    "exit-codes": Topic(
        "What a command's exit code says",
        "reference/exit-codes.md",
        """\
0    good
1    bad input: a line on stderr names file, frame or argument
2    bad command line
3    the result is bad: too many failed frames, a broken limit, errors of `check`
130  Ctrl-C; 143 SIGTERM. Finished frames are kept.

A traceback is a bug of ours: please report it, with work/log.jsonl and what `capture4d doctor` prints.""",
    ),
    "units": Topic(
        "Metres, and what else scans come in",
        "reference/files.md",
        """\
Inside, all is in metres, seconds, right-handed, Y up. capture.json says what scans are in:
"units": "m", "cm", "mm" or "in". `check` says if that cannot be; --fix corrects it.

template --units and register-mesh --units speak of the meshes they are given; motions say or show theirs.
Reports are in millimetres.""",
    ),
    "colours": Topic(
        "How the garment is told from the rest",
        "methods/extraction.md",
        """\
By its colour, and its borders by paint. capture.json may name them, as #rrggbb:
"garment_colour", and "boundary_colours" with one for each border loop, such as "neck" and "hem".

Without garment_colour they are learned from the scans; --learn-colours learns them all the same.
`capture4d check` says whether the colours are in the scans and apart enough.""",
    ),
}


def list_of_topics() -> str:
    """The topics, a line each."""
    lines = ["capture4d help TOPIC explains; capture4d help COMMAND is that command's --help.", ""]
    lines += [f"  {name:<17} {topic.title}" for name, topic in TOPICS.items()]
    return "\n".join(lines)


def topic_text(name: str) -> str:
    """One of them, and where to read on."""
    topic = TOPICS[name]
    shown = (paragraph if _STANDS.search(paragraph) else filled(paragraph) for paragraph in topic.text.split("\n\n"))
    return "\n\n".join((topic.title, *shown, f"More: docs/{topic.page}"))
