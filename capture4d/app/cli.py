"""The `capture4d` command: one subcommand per stage, and `run` for all of them.

Bad input ends in one line on stderr and exit code 1, a broken limit in exit code 1, a wrong command line in 2, Ctrl-C
in 130; `check` grades a take by 0, 1 and 2; anything else is a bug and keeps its traceback.
"""

from __future__ import annotations

import dataclasses
import difflib
import errno
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import tyro
from tyro.conf import Positional, UseAppendAction, arg

from capture4d.app.cli_options import StageOptions, all_cores
from capture4d.app.cli_wrinkles import Compare, WrinklesApply, WrinklesMaps, WrinklesTrain
from capture4d.body_tracking_config import TrackingConfig
from capture4d.calibration_config import CalibrationConfig, RigCheckConfig
from capture4d.errors import InputError
from data_synth import config as synth_config
from data_synth.scanner_config import ScanConfig
from registration import config as registration_config
from registration.config import MeshRegistrationConfig, RegistrationConfig
from wrinkles import config as wrinkle_config

# What a user's disk can answer; the message names the path, and a traceback would add nothing.
_DISK_ANSWERS = {
    errno.EACCES,
    errno.EDQUOT,
    errno.EISDIR,
    errno.ENOENT,
    errno.ENOSPC,
    errno.ENOTDIR,
    errno.EPERM,
    errno.EROFS,
}


@dataclass(frozen=True, kw_only=True)
class Demo(StageOptions):
    """Make a synthetic capture, register it, and report: the whole pipeline in minutes."""

    output: Path = Path("out")
    """Folder for everything, the capture included."""

    def __call__(self) -> int:
        from capture4d.app.pipeline import run_demo

        print(f"report: {run_demo(self.output, workers=self.workers, overwrite=self.overwrite)}")
        return 0


def _with_sensor(config: Any, sensor: Literal["depth", "stereo"] | None) -> Any:
    """Settings of a synthetic capture with another scanner, if one is given."""
    if sensor is None:
        return config
    return dataclasses.replace(config, scanner=dataclasses.replace(config.scanner, sensor=sensor))


@dataclass(frozen=True, kw_only=True)
class Synth(StageOptions):
    """Simulate a garment on a moving body and scan it: a capture folder with its exact truth."""

    output: Annotated[Positional[Path], arg(metavar="OUTPUT")]
    """Capture folder to write."""
    preset: Literal[*synth_config.PRESETS] = "demo"
    """What the settings below start from."""
    scanner: Literal["depth", "stereo"] | None = None
    """Short for --scanner.sensor."""
    config: Annotated[synth_config.SynthConfig, arg(name="")] = field(default_factory=synth_config.SynthConfig)

    def __call__(self) -> int:
        from data_synth.stage import run

        run(self.output, _with_sensor(self.config, self.scanner), workers=self.workers, overwrite=self.overwrite)
        print(f"capture: {self.output}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Scan(StageOptions):
    """Scan your own mesh sequence with the virtual camera rig: a capture folder, with truth if the faces stay."""

    meshes: Annotated[Positional[Path], arg(metavar="MESHES")]
    """Folder of mesh files, one per frame in order of name; or .npz with vertices (T, V, 3) and faces (F, 3)."""
    output: Annotated[Positional[Path], arg(metavar="OUTPUT")]
    """Capture folder to write."""
    template: Path | None = None
    """Mesh to register later: lies on the first mesh, or is the same mesh in another pose."""
    scanner: Literal["depth", "stereo"] | None = None
    """Short for --scanner.sensor."""
    config: Annotated[ScanConfig, arg(name="")] = field(default_factory=ScanConfig)

    def __call__(self) -> int:
        from data_synth.scan_stage import run

        run(
            self.meshes,
            self.output,
            _with_sensor(self.config, self.scanner),
            template=self.template,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"capture: {self.output}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Check:
    """Look through a take before a night is spent on it; exit code 0: clean, 1: warnings, 2: errors."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder, or just a folder of scans."""
    frames: str | None = None
    """How scans are named, such as "take_{frame}.ply"; else the last number in a name is the frame's."""
    fps: float | None = None
    """Frame rate, if capture.json does not say, or is to be doubted."""
    units: Literal["m", "cm", "mm", "in"] | None = None
    """What the scans are said to be in, likewise."""
    garment_colour: str | None = None
    """Such as #2f62c9, likewise."""
    border_colour: UseAppendAction[tuple[str, ...]] = ()
    """A paint on the borders, likewise; may be given several times."""
    rig: Path | None = None
    """rig.json, if it is not in the folder."""
    poses: Path | None = None
    """poses.npz, likewise."""
    body: Path | None = None
    """body.npz, likewise."""
    all: bool = False
    """Look at every frame instead of a sample."""
    fix: bool = False
    """Write a corrected take to CAPTURE-fixed; looks at every frame."""
    json: bool = False
    """Print JSON instead of a table."""
    workers: int = field(default_factory=all_cores)
    """Processes to use; the result does not depend on it."""

    def __call__(self) -> int:
        import json

        from capture4d.app.check import as_json, check_take, exit_code, print_table
        from capture4d.app.check_fix import write_fixed
        from capture4d.app.check_take import Claims

        claims = Claims(
            self.frames,
            self.fps,
            self.units,
            self.garment_colour,
            self.border_colour,
            self.rig,
            self.poses,
            self.body,
        )
        checked = check_take(self.capture, claims, all_frames=self.all or self.fix, workers=self.workers)
        fixed = write_fixed(checked, workers=self.workers) if self.fix and checked.verdict.findings else None
        if self.json:
            print(json.dumps(as_json(checked, fixed=fixed), indent=2))
        else:
            print_table(checked)
            if fixed is not None:
                print(f"corrected: {fixed}")
        return exit_code(checked.verdict)


@dataclass(frozen=True, kw_only=True)
class Extract(StageOptions):
    """Cut the garment out of every scan by its colour, and find its painted borders."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; gets garment/."""
    learn_colours: bool = False
    """Learn the colours from the scans even where capture.json gives them; they then say which is which. Without
    garment_colour in capture.json they are learned anyway."""

    def __call__(self) -> int:
        from capture4d.garment_stage import run

        run(
            self.capture,
            self.output / "garment",
            learn_colours=self.learn_colours,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"garment: {self.output / 'garment'}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Track(StageOptions):
    """Track the body through every scan: its poses, and one shape for the take."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; gets body/."""
    config: Annotated[TrackingConfig, arg(name="")] = field(default_factory=TrackingConfig)

    def __call__(self) -> int:
        from capture4d.body_stage import run

        run(self.capture, self.output / "body", self.config, workers=self.workers, overwrite=self.overwrite)
        print(f"body: {self.output / 'body'}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Register(StageOptions):
    """Register the template to every frame whose garment `extract` has cut out."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder; holds garment/ and gets registration/."""
    tracked: bool = False
    """Move the template with the body that `track` found, not with the poses the capture brings."""
    preset: Literal["default", "paper"] = "default"
    """What the settings below start from; `paper` is DeepWrinkles as printed."""
    config: Annotated[RegistrationConfig, arg(name="")] = field(default_factory=RegistrationConfig)

    def __call__(self) -> int:
        from registration.stage import run

        run(
            self.capture,
            self.output / "garment",
            self.output / "registration",
            self.config,
            body_folder=self.output / "body" if self.tracked else None,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"registration: {self.output / 'registration'}")
        return 0


@dataclass(frozen=True, kw_only=True)
class RegisterMesh:
    """Register any template to any scan, two mesh files; writes the result, and its measures as JSON beside it."""

    template: Annotated[Positional[Path], arg(metavar="TEMPLATE")]
    """Mesh to deform: obj, ply or glb. Its vertex order and faces are kept."""
    scan: Annotated[Positional[Path], arg(metavar="SCAN")]
    """Mesh to fit it to: obj, ply or glb."""
    output: Path
    """Mesh to write: ply, obj or glb; the JSON has the same name."""
    config: Annotated[MeshRegistrationConfig, arg(name="")] = field(default_factory=MeshRegistrationConfig)

    def __call__(self) -> int:
        from registration.register_mesh import run

        run(self.template, self.scan, self.output, self.config)
        print(f"registered: {self.output}, measures: {self.output.with_suffix('.json')}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Template:
    """Make a template of your own garment mesh, or of a part of the body: bound, its borders named, its UVs checked."""

    mesh: Annotated[Positional[Path | None], arg(metavar="MESH")] = None
    """Garment mesh that lies on the body: obj, ply or glb. Left out with --region."""
    output: Path
    """template.npz to write, as in a capture folder."""
    body: Path | None = None
    """The body it lies on, a body.npz; the built-in one if absent."""
    poses: Path | None = None
    """Motion file with the pose and the shape in which the garment lies on the body; the rest pose of the mean shape if
    absent."""
    frame: int | None = None
    """Frame of that file, by its number; the first if absent."""
    region: Literal["tshirt", "longsleeve", "trousers", "shorts"] | None = None
    """Take this part of the body as the garment."""
    uv: Literal["auto", "keep", "fresh", "none"] = "auto"
    """Keep the mesh's UVs or cut fresh ones; `auto` keeps them if nothing is wrong with them."""
    names: tuple[str, ...] = ()
    """Names of the border loops, the one with the most vertices first; found by their place if absent."""
    units: Literal["m", "cm", "mm", "in"] = "m"
    """Of the mesh."""

    def __call__(self) -> int:
        from capture4d.template_stage import run

        garment, report = run(
            self.mesh,
            self.output,
            body=self.body,
            poses=self.poses,
            frame=self.frame,
            region=self.region,
            uv=self.uv,
            names=self.names,
            units=self.units,
        )
        loops = ", ".join(f"{name} ({len(loop)})" for name, loop in garment.loops.items())
        faults = ", ".join(report.uv.faults())
        cut = f"cut afresh{f' ({faults})' if faults else ''}"
        uvs = "none" if garment.template.uv is None else cut if report.fresh_uv else "kept"
        print(f"{report.vertices} vertices, {report.faces} faces, {1e3 * report.distance_m:.1f} mm from the body")
        print(f"borders: {loops}")
        print(f"UVs: {uvs}")
        print(f"template: {self.output}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Run(StageOptions):
    """Run every stage on a capture: extract, track if it brings no poses, register, report."""

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """Capture folder."""
    output: Path
    """Work folder."""
    preset: Literal["default", "paper"] = "default"
    """What the settings of the registration start from; `paper` is DeepWrinkles as printed."""
    track: bool = False
    """Track the body even if the capture brings poses."""
    config: Annotated[RegistrationConfig, arg(name="registration")] = field(default_factory=RegistrationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def __call__(self) -> int:
        from capture4d.app.pipeline import run_all

        report = run_all(
            self.capture,
            self.output,
            self.config,
            tracking=self.tracking,
            track=self.track,
            workers=self.workers,
            overwrite=self.overwrite,
        )
        print(f"report: {report}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Report(StageOptions):
    """Draw the report of a registered capture, and check its metrics against limits."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder; holds registration/ and gets report/."""
    fail_above: UseAppendAction[tuple[Annotated[str, arg(metavar="METRIC=LIMIT")], ...]] = ()
    """Exit with 1 if this metric of report/metrics.json is above the limit; may be given several times."""
    capture: Path | None = None
    """Capture folder, if it is not where it was when it was registered."""

    def __call__(self) -> int:
        from capture4d.app.pipeline import broken_limits, parse_limits, run_report

        limits = parse_limits(self.fail_above)
        page = run_report(self.work, capture=self.capture, workers=self.workers, overwrite=self.overwrite)
        print(f"report: {page}")
        broken = broken_limits(self.work, limits)
        for line in broken:
            print(f"capture4d: {line}", file=sys.stderr)
        return 1 if broken else 0


@dataclass(frozen=True)
class ConvertBody:
    """Convert a body model of the SMPL family, from your own licensed file, to a body.npz for captures."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """SMPL, SMPL-H or SMPL-X model, .npz, or .pkl (read without running its code)."""
    output: Path
    """File to write, as body.npz in a capture folder."""

    def __call__(self) -> int:
        from capture4d.body_smpl import convert_smpl

        convert_smpl(self.file, self.output)
        print(f"body: {self.output}")
        return 0


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Calibrate a camera rig from images of a ChArUco board, with a report of how good it is."""

    images: Annotated[Positional[Path], arg(metavar="IMAGES")]
    """Folder of board images: png, jpg or tif, one a camera and pose of the board."""
    board: str
    """charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY, such as charuco:14x10:60:44:DICT_5X5_100."""
    output: Path
    """rig.json to write; calibration.json and calibration.html go beside it."""
    pattern: str = "{camera}/{pose}"
    """How the images lie in the folder, without their ending."""
    workers: int = field(default_factory=all_cores)
    """Processes to use; the result does not depend on it."""
    colmap: Path | None = None
    """Folder for the rig as a COLMAP model as well."""
    config: Annotated[CalibrationConfig, arg(name="")] = field(default_factory=CalibrationConfig)

    def __call__(self) -> int:
        from capture4d.app.calibration_page import print_calibration, write_page
        from capture4d.calibration_stage import run

        report = run(
            self.images,
            self.output,
            self.board,
            self.config,
            pattern=self.pattern,
            colmap=self.colmap,
            workers=self.workers,
        )
        print_calibration(report)
        page = write_page(self.output.with_name("calibration.html"), report)
        print(f"rig: {self.output}, report: {page}")
        return 0


@dataclass(frozen=True, kw_only=True)
class CheckRig:
    """Tell which cameras have moved since calibration, from one pose of the board; exits with 1 if one has."""

    rig: Annotated[Positional[Path], arg(metavar="RIG")]
    """rig.json; the calibration.json beside it knows the board and how certain the rig is."""
    images: Annotated[Positional[Path], arg(metavar="IMAGES")]
    """Folder of board images: png, jpg or tif; one pose will do."""
    board: str | None = None
    """The board, if it is not the one of the calibration."""
    pattern: str = "{camera}/{pose}"
    """How the images lie in the folder, without their ending."""
    workers: int = field(default_factory=all_cores)
    """Processes to use; the result does not depend on it."""
    config: Annotated[RigCheckConfig, arg(name="")] = field(default_factory=RigCheckConfig)

    def __call__(self) -> int:
        from capture4d.app.calibration_page import print_check
        from capture4d.calibration_stage import run_check

        checks = run_check(
            self.rig, self.images, self.config, board=self.board, pattern=self.pattern, workers=self.workers
        )
        print_check(checks)
        moved = [check.name for check in checks if check.verdict == "moved"]
        if moved:
            print(f"capture4d: moved since calibration: {', '.join(moved)}", file=sys.stderr)
        return 1 if moved else 0


@dataclass(frozen=True)
class ConvertRig:
    """Convert a rig.json to a COLMAP model, or a COLMAP model to a rig.json."""

    source: Annotated[Positional[Path], arg(metavar="SOURCE")]
    """rig.json, or a folder with a COLMAP model, binary or text."""
    output: Path
    """Folder for the model, or rig.json."""
    text: bool = False
    """Write the model as text."""

    def __call__(self) -> int:
        from capture4d.calibration_stage import convert

        convert(self.source, self.output, text=self.text)
        print(f"rig: {self.output}")
        return 0


@dataclass(frozen=True)
class ConvertPoses:
    """Convert a motion between poses.npz, AMASS npz and BVH, retargeted to a body where the skeletons differ."""

    input: Annotated[Positional[Path], arg(metavar="IN")]
    """Motion file, .npz or .bvh; what kind of npz is told by its arrays."""
    output: Annotated[Positional[Path], arg(metavar="OUT")]
    """Motion file to write, .npz or .bvh."""
    body: Path | None = None
    """The body that moves, a body.npz; the built-in one if absent."""
    format: Literal["poses", "amass"] = "poses"
    """What kind of .npz to write."""
    fps: float | None = None
    """Frame rate of the result; that of the input if absent."""

    def __call__(self) -> int:
        from capture4d.body_anny import load_anny
        from capture4d.motion_files import read_motion, write_motion
        from capture4d.records import load_body

        body = load_body(self.body) if self.body else load_anny()
        poses = read_motion(self.input, body, fps=self.fps)
        write_motion(self.output, body, poses, amass=self.format == "amass")
        print(f"{len(poses.frame_ids)} poses at {poses.fps:g} fps: {self.output}")
        return 0


_COMMANDS: Mapping[str, Any] = {
    "demo": Demo,
    "synth": Synth,
    "scan": Scan,
    "check": Check,
    "template": Template,
    "extract": Extract,
    "track": Track,
    "register": Register,
    "run": Run,
    "report": Report,
    "wrinkles maps": WrinklesMaps,
    "wrinkles train": WrinklesTrain,
    "wrinkles apply": WrinklesApply,
    "compare": Compare,
    "register-mesh": RegisterMesh,
    "calibrate": Calibrate,
    "check-rig": CheckRig,
    "convert-body": ConvertBody,
    "convert-rig": ConvertRig,
    "convert-poses": ConvertPoses,
}

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
    sys.exit(_run(list(sys.argv[1:] if arguments is None else arguments)))


def _run(arguments: list[str]) -> int:
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
        return code
    except InputError as error:
        return _complain(str(error))
    except BrokenPipeError:  # whoever read our output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if error.errno not in _DISK_ANSWERS or (error.filename is None and error.errno != errno.ENOSPC):
            raise
        kept = "; finished frames are kept, the same command goes on" if error.errno == errno.ENOSPC else ""
        return _complain(f"{error.filename or 'output'}: {error.strerror}{kept}")
    except RuntimeError as error:
        from capture4d.workdir import WorkerDied

        if not isinstance(error, WorkerDied):
            raise
        return _complain(str(error))
    except KeyboardInterrupt:
        return _complain("interrupted; finished frames are kept, the same command goes on", code=130)


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(f"capture4d {version('capture4d')}")
        return 0
    name, *rest = arguments
    if any(command.startswith(f"{name} ") for command in _COMMANDS):  # a group, such as `wrinkles train`
        if not rest or rest[0] in ("-h", "--help"):
            print(_overview(f"{name} "))
            return 0 if rest else 2
        name, rest = f"{name} {rest[0]}", rest[1:]
    if name not in _COMMANDS:
        near = difflib.get_close_matches(name, _COMMANDS, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        return _complain(f"unknown command '{name}'{hint} (see capture4d --help)", code=2)
    return _parse(name, rest)()


def _parse(name: str, arguments: list[str]) -> Any:
    """The command with its options. A --preset decides what the other settings start from."""
    command = _COMMANDS[name]
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
    return tyro.cli(command, prog=f"capture4d {name}", args=arguments, default=default)


def _value_of(option: str, arguments: list[str]) -> str | None:
    for index, argument in enumerate(arguments):
        if argument == option:
            return next(iter(arguments[index + 1 :]), None)
        if argument.startswith(f"{option}="):
            return argument.partition("=")[2]
    return None


def _overview(group: str = "") -> str:
    lines = [
        f"  {name:<15} {(command.__doc__ or '').splitlines()[0]}"
        for name, command in _COMMANDS.items()
        if name.startswith(group)
    ]
    return "\n".join(
        [
            "usage: capture4d COMMAND ...",
            "",
            "4D garment capture: non-rigid registration of coloured scans, and a synthetic 4D scanner.",
            "",
            *lines,
            "",
            "capture4d COMMAND --help lists a command's options. Every command resumes where it was stopped.",
        ]
    )


def _complain(message: str, *, code: int = 1) -> int:
    print(f"capture4d: {' '.join(message.splitlines())}", file=sys.stderr)
    return code
