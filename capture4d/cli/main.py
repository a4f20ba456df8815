"""The `capture4d` command: one subcommand per stage, and `run` for all of them.

Whatever goes wrong with the input ends in one line on stderr; `capture4d.cli.exit_codes` says what the codes mean.
Anything else is a bug and keeps its traceback.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import tyro

from capture4d.cli.commands.capture import Calibrate, Check, CheckRig
from capture4d.cli.commands.doctor import Doctor
from capture4d.cli.commands.files import ConvertBody, ConvertPoses, ConvertRig, RegisterMesh, Template
from capture4d.cli.commands.models import Animate, Fit
from capture4d.cli.commands.stages import Extract, Register, Report, Run, Track
from capture4d.cli.commands.synthesis import Demo, Scan, Synth, SynthBoard
from capture4d.cli.commands.wrinkles import Compare, WrinklesApply, WrinklesMaps, WrinklesOffsets, WrinklesTrain
from capture4d.cli.exit_codes import BAD_COMMAND_LINE, BAD_INPUT, GOOD, INTERRUPTED, TERMINATED
from capture4d.cli.faults import check_command
from capture4d.errors import CommandLineError, InputError
from capture4d.runs.address_space import memory_fault, require_address_space
from capture4d.settings import gathered_faults
from data_synth import config as synth_config
from registration import config as registration_config
from wrinkles.normal_maps import config as wrinkle_config

__all__ = ["COMMANDS", "main"]

# What a user's disk can answer; the message names the path, and a traceback would add nothing.
_DISK_ANSWERS = {
    errno.EACCES,
    errno.EDQUOT,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENOENT,
    errno.ENOSPC,
    errno.ENOTDIR,
    errno.EPERM,
    errno.EROFS,
}

_ALLOW_OUTSIDE = "CAPTURE4D_ALLOW_OUTSIDE"
"""As `capture4d.files.reading` knows it, which loads more than the command line should."""

COMMANDS: Mapping[str, Any] = {
    "demo": Demo,
    "synth": Synth,
    "scan": Scan,
    "synth-board": SynthBoard,
    "check": Check,
    "template": Template,
    "extract": Extract,
    "track": Track,
    "register": Register,
    "run": Run,
    "report": Report,
    "fit": Fit,
    "animate": Animate,
    "wrinkles maps": WrinklesMaps,
    "wrinkles train": WrinklesTrain,
    "wrinkles apply": WrinklesApply,
    "wrinkles offsets": WrinklesOffsets,
    "compare": Compare,
    "register-mesh": RegisterMesh,
    "calibrate": Calibrate,
    "check-rig": CheckRig,
    "convert-body": ConvertBody,
    "convert-rig": ConvertRig,
    "convert-poses": ConvertPoses,
    "doctor": Doctor,
}

_WRITE_FILES = (Check, Template, RegisterMesh, Calibrate, ConvertBody, ConvertPoses, ConvertRig)
"""Commands whose output is a file among others, or a folder that comes to be at the end; that of the rest is a folder
of their own."""

_PRESETS: Mapping[Any, Mapping[str, Any]] = {
    Synth: synth_config.PRESETS,
    Register: registration_config.PRESETS,
    Run: registration_config.PRESETS,
    WrinklesTrain: wrinkle_config.PRESETS,
}


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run one command and exit with its code."""
    # One thread per process: frames run in parallel as processes, results do not depend on the machine, and CPU time
    # is what the work costs. Numerical libraries read these as they load, which is later.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    with _answering_to_termination():
        sys.exit(_run(list(sys.argv[1:] if arguments is None else arguments)))


class _TerminatedError(BaseException):
    """SIGTERM, which a scheduler sends to a job whose time is up."""


@contextlib.contextmanager
def _answering_to_termination() -> Iterator[None]:
    def terminate(number: int, frame: object) -> None:
        raise _TerminatedError

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
    except CommandLineError as error:
        return _complain(str(error), code=BAD_COMMAND_LINE)
    except InputError as error:
        return _complain(str(error))
    except BrokenPipeError:  # whoever read our output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return GOOD
    except OSError as error:
        if error.errno not in _DISK_ANSWERS or (error.filename is None and error.errno != errno.ENOSPC):
            raise
        kept = "; finished frames are kept, the same command goes on" if error.errno == errno.ENOSPC else ""
        return _complain(f"{error.filename or 'output'}: {error.strerror}{kept}")
    except RuntimeError as error:
        from capture4d.runs.workers import WorkerDied

        if not isinstance(error, WorkerDied):
            raise
        return _complain(str(error))
    except (MemoryError, ImportError) as error:
        said = memory_fault(error)
        if said is None:
            raise
        return _complain(said)
    except KeyboardInterrupt:
        return _complain("interrupted; finished frames are kept, the same command goes on", code=INTERRUPTED)
    except _TerminatedError:
        return _complain("terminated; finished frames are kept, the same command goes on", code=TERMINATED)


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return GOOD if arguments else BAD_COMMAND_LINE
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(f"capture4d {version('capture4d')}")
        return GOOD
    name, *rest = arguments
    if any(command.startswith(f"{name} ") for command in COMMANDS):  # a group, such as `wrinkles train`
        if not rest or rest[0] in ("-h", "--help"):
            print(_overview(f"{name} "))
            return GOOD if rest else BAD_COMMAND_LINE
        name, rest = f"{name} {rest[0]}", rest[1:]
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        return _complain(f"unknown command '{name}'{hint} (see capture4d --help)", code=BAD_COMMAND_LINE)
    command = _parse(name, rest)
    require_address_space(name)
    with _allowing(command), _alone(command):
        return command()


def _parse(name: str, arguments: list[str]) -> Any:
    """The command with its options. A --preset decides what the other settings start from.

    Raises:
        InputError: an option is out of range.
    """
    command = COMMANDS[name]
    presets = _PRESETS.get(command)
    default = None
    if presets:
        given = _value_of("--preset", arguments) or next(iter(presets))
        if given in presets:
            required = {
                entry.name: tyro.MISSING
                for entry in dataclasses.fields(command)
                if entry.default is entry.default_factory is dataclasses.MISSING
            }
            default = command(**required, preset=given, config=presets[given])
    with gathered_faults() as faults:  # tyro would print a page about each
        parsed = tyro.cli(command, prog=f"capture4d {name}", args=arguments, default=default)
    check_command(parsed, faults, arguments)
    return parsed


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


def _value_of(option: str, arguments: list[str]) -> str | None:
    for index, argument in enumerate(arguments):
        if argument == option:
            return next(iter(arguments[index + 1 :]), None)
        if argument.startswith(f"{option}="):
            return argument.partition("=")[2]
    return None


def _overview(group: str = "") -> str:
    lines = [
        f"  {name:<17} {(command.__doc__ or '').splitlines()[0]}"
        for name, command in COMMANDS.items()
        if name.startswith(group)
    ]
    return "\n".join(
        [
            "usage: capture4d COMMAND ...",
            "",
            "4D garment capture: registration of coloured scans, learned garments, and a synthetic 4D scanner.",
            "",
            *lines,
            "",
            "capture4d COMMAND --help lists a command's options. Every command resumes where it was stopped.",
        ]
    )


def _complain(message: str, *, code: int = BAD_INPUT) -> int:
    print(f"capture4d: {' '.join(message.splitlines())}", file=sys.stderr)
    return code
