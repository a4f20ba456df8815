"""The `capture4d` command: one subcommand per stage, and `run` for all of them.

Whatever goes wrong with the input ends in one line on stderr; `capture4d.cli.exit_codes` says what the codes mean.
Anything else is a bug and keeps its traceback.
"""

from __future__ import annotations

import contextlib
import difflib
import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from capture4d.cli.answers import TerminatedError, answer_to, complain
from capture4d.cli.commands.capture import Calibrate, Check, CheckRig
from capture4d.cli.commands.drape_offsets import OffsetsPredict, OffsetsTrain
from capture4d.cli.commands.exchange import Export, ExportOnnx, Import, Score, Texture
from capture4d.cli.commands.files import ConvertBody, ConvertPoses, ConvertRig, RegisterMesh, Template
from capture4d.cli.commands.folders import Diff, Status
from capture4d.cli.commands.live import TryOn, View
from capture4d.cli.commands.models import Animate, Fit, FitStyle, FitStyles
from capture4d.cli.commands.offsets import OffsetsApply, OffsetsDraw, OffsetsEdit
from capture4d.cli.commands.stages import Extract, Register, Report, Run, Track
from capture4d.cli.commands.synthesis import Demo, Scan, Synth, SynthBoard, SynthDrapes
from capture4d.cli.commands.upkeep import Cache, Doctor
from capture4d.cli.commands.wrinkles import Compare, WrinklesApply, WrinklesMaps, WrinklesOffsets, WrinklesTrain
from capture4d.cli.exit_codes import BAD_COMMAND_LINE, BAD_INPUT, GOOD
from capture4d.cli.help_text import command_help, overview
from capture4d.cli.options import ProgressOptions, StageOptions, all_cores
from capture4d.cli.parsing import command_options, parse
from capture4d.runs.address_space import require_address_space
from data_synth import config as synth_config
from registration import config as registration_config
from retarget.mixture import config as mixture_config
from wrinkles.normal_maps import config as wrinkle_config
from wrinkles.offset_images import config as offset_config

__all__ = ["COMMANDS", "main"]

_ALLOW_OUTSIDE = "CAPTURE4D_ALLOW_OUTSIDE"
"""As `capture4d.files.reading` knows it, which loads more than the command line should."""

COMMANDS: Mapping[str, Any] = {
    "demo": Demo,
    "synth": Synth,
    "scan": Scan,
    "synth-board": SynthBoard,
    "synth-drapes": SynthDrapes,
    "check": Check,
    "template": Template,
    "extract": Extract,
    "track": Track,
    "register": Register,
    "run": Run,
    "report": Report,
    "status": Status,
    "diff": Diff,
    "view": View,
    "fit": Fit,
    "fit-styles": FitStyles,
    "fit-style": FitStyle,
    "animate": Animate,
    "tryon": TryOn,
    "wrinkles maps": WrinklesMaps,
    "wrinkles train": WrinklesTrain,
    "wrinkles apply": WrinklesApply,
    "wrinkles offsets": WrinklesOffsets,
    "offsets train": OffsetsTrain,
    "offsets predict": OffsetsPredict,
    "offsets draw": OffsetsDraw,
    "offsets edit": OffsetsEdit,
    "offsets apply": OffsetsApply,
    "compare": Compare,
    "texture": Texture,
    "export": Export,
    "export-onnx": ExportOnnx,
    "import": Import,
    "score": Score,
    "register-mesh": RegisterMesh,
    "calibrate": Calibrate,
    "check-rig": CheckRig,
    "convert-body": ConvertBody,
    "convert-rig": ConvertRig,
    "convert-poses": ConvertPoses,
    "doctor": Doctor,
    "cache": Cache,
}

_WRITE_FILES = (Check, FitStyle, Template, RegisterMesh, Calibrate, ConvertBody, ConvertPoses, ConvertRig, Diff,
                OffsetsDraw, OffsetsEdit, OffsetsApply)  # fmt: skip
"""Commands whose output is a file among others, or a folder that comes to be at the end; that of the rest is a folder
of their own."""

_PRESETS: Mapping[Any, Mapping[str, Any]] = {
    Synth: synth_config.PRESETS,
    Register: registration_config.PRESETS,
    Run: registration_config.PRESETS,
    WrinklesTrain: wrinkle_config.PRESETS,
    FitStyles: mixture_config.PRESETS,
    OffsetsTrain: offset_config.PRESETS,
}


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run one command and exit with its code."""
    # One thread per process: frames run in parallel as processes, results do not depend on the machine, and CPU time
    # is what the work costs. Numerical libraries read these as they load, which is later.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    # What is known of a long take is hundreds of thousands of small objects, none in a circle; looking through them for
    # circles at the usual rate took half of the time in which a finished take says so.
    gc.set_threshold(50_000, 20, 100)
    with _answering_to_termination():
        sys.exit(_run(list(sys.argv[1:] if arguments is None else arguments)))


@contextlib.contextmanager
def _answering_to_termination() -> Iterator[None]:
    def terminate(number: int, frame: object) -> None:
        raise TerminatedError

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _run(arguments: list[str]) -> int:
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
        return code
    except BaseException as error:
        answer = answer_to(error, arguments)
        if answer is None:
            raise
        return answer


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "--help-all"):
        print(overview(COMMANDS))
        return GOOD if arguments else BAD_COMMAND_LINE
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(f"capture4d {version('capture4d')}")
        return GOOD
    if arguments[0] == "help":
        return _help(arguments[1:])
    name, *rest = arguments
    if any(command.startswith(f"{name} ") for command in COMMANDS):  # a group, such as `wrinkles train`
        if not rest or rest[0] in ("-h", "--help", "--help-all"):
            print(overview(COMMANDS, f"{name} "))
            return GOOD if rest else BAD_COMMAND_LINE
        name, rest = f"{name} {rest[0]}", rest[1:]
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        return complain(f"unknown command '{name}'{hint} (see capture4d --help)", code=BAD_COMMAND_LINE)
    kind, presets = COMMANDS[name], _PRESETS.get(COMMANDS[name])
    if {"-h", "--help", "--help-all"} & {*rest}:
        print(command_help(name, kind, command_options(kind, rest, presets), experts="--help-all" in rest))
        return GOOD
    command = parse(name, kind, rest, presets)
    require_address_space(name)
    if getattr(command, "dry_run", False):  # nothing is written: no lock, no log, not even a folder
        with _showing(command), _allowing(command):
            return command()
    with _showing(command), _allowing(command), _alone(command), _spreading(command), _keeping_workers():
        return _logged(command, arguments)


def _help(words: list[str]) -> int:
    """`capture4d help`, `help TOPIC` and `help COMMAND`."""
    from capture4d.cli.topics import TOPICS, list_of_topics, topic_text

    asked = " ".join(words)
    if not asked:
        print(list_of_topics())
        return GOOD
    if asked in TOPICS:
        print(topic_text(asked))
        if asked in COMMANDS:
            print(f"Options: capture4d {asked} --help")
        return GOOD
    if asked in COMMANDS or any(command.startswith(f"{asked} ") for command in COMMANDS):
        return _dispatch([*words, "--help"])
    near = difflib.get_close_matches(asked, [*TOPICS, *COMMANDS], n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return complain(f"no help on '{asked}'{hint} (see capture4d help)", code=BAD_COMMAND_LINE)


@contextlib.contextmanager
def _showing(command: Any) -> Iterator[None]:
    """Progress as the command line wants it."""
    if not isinstance(command, ProgressOptions):
        yield
        return
    from capture4d.runs.progress import progress_style

    with progress_style(command.style):
        yield


@contextlib.contextmanager
def _spreading(command: Any) -> Iterator[None]:
    """A cluster does the work, if there is to be one."""
    address = getattr(command, "scheduler", None)
    if address is None:
        yield
        return
    from capture4d.runs.cluster.scheduler import use_scheduler

    with use_scheduler(address):
        yield


@contextlib.contextmanager
def _keeping_workers() -> Iterator[None]:
    """Worker processes go from step to step of the command."""
    from capture4d.runs.processes.pool import kept_workers

    with kept_workers():
        yield


def _logged(command: Any, arguments: list[str]) -> int:
    """Run the command, with a log in its work folder, if it has one."""
    folder = _log_folder(command)
    if folder is None:
        return command()
    from capture4d.runs.run_log import run_log

    with run_log(folder, arguments, command, cores=all_cores()) as log:
        try:
            code = command()
        except BaseException as error:
            answer = answer_to(error, arguments)
            log.fault(error)
            log.end(BAD_INPUT if answer is None else answer)  # Python's own code, of a bug
            if answer is None:
                raise
            return answer
        log.end(code)
        return code


@contextlib.contextmanager
def _alone(command: Any) -> Iterator[None]:
    """No other command writes to the same place meanwhile."""
    output = _written_by(command)
    if output is None:
        yield
        return
    from capture4d.runs.locks import alone

    folder = not isinstance(command, _WRITE_FILES)
    with alone(output, folder=folder, wait=getattr(command, "wait", None)):
        yield


def _written_by(command: Any) -> Path | None:
    """The folder, or the file, that a command writes to; None if it writes nothing."""
    if isinstance(command, Check):
        from capture4d.preflight.repair.fix import fixed_path

        return command.output or fixed_path(command.capture) if command.fix else None
    if isinstance(command, Report):
        return command.work / "report" if command.work.is_dir() else None
    if isinstance(command, Fit) and command.output is None:
        return command.works[0] if command.works and command.works[0].is_dir() else None
    work = getattr(command, "work", None)
    return getattr(command, "output", None) or (work if work is not None and work.is_dir() else None)


def _log_folder(command: Any) -> Path | None:
    """The folder of a command's log: the work folder, or the model's; None of a command that writes anything else."""
    if isinstance(command, _WRITE_FILES) or not isinstance(command, StageOptions):
        return None
    if isinstance(command, Synth | Scan | SynthBoard | SynthDrapes):  # equal settings give equal folders, byte for byte
        return None
    if isinstance(command, Fit) and command.output is None:
        return next(iter(command.works), None)
    return getattr(command, "output", None) or getattr(command, "work", None)


@contextlib.contextmanager
def _allowing(command: Any) -> Iterator[None]:
    """What a command allows its readers is told by the environment, which worker processes inherit."""
    before = os.environ.get(_ALLOW_OUTSIDE)
    if getattr(command, "allow_outside", False):
        os.environ[_ALLOW_OUTSIDE] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_ALLOW_OUTSIDE, None)
        else:
            os.environ[_ALLOW_OUTSIDE] = before
