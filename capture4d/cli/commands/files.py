"""`capture4d template`, `register-mesh` and the converters: single files in, single files out."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from capture4d.cli.exit_codes import BAD_RESULT, GOOD
from capture4d.cli.options import MeshOptions
from capture4d.settings import Positive, Whole
from capture4d.templates.config import Axis, Follow, MeshUnits, Region, TemplateConfig, UvChoice
from registration.config import MeshRegistrationConfig

__all__ = ["ConvertBody", "ConvertPoses", "ConvertRig", "RegisterMesh", "Template"]


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Of commands whose output is a file among others of the user's."""

    overwrite: bool = False
    """Write over a file that is there and holds something else than this result; never over an input."""


@dataclass(frozen=True, kw_only=True)
class Template(FileOptions, MeshOptions):
    """Make a template of your own garment mesh, or of a part of the body: bound, its borders named, its UVs checked."""

    mesh: Annotated[Positional[Path | None], arg(metavar="MESH")] = None
    """Garment mesh that lies on the body: obj, ply, glb, gltf, stl or off. Left out with --region."""
    output: Path
    """template.npz to write, as in a capture folder."""
    body: Path | None = None
    """The body it lies on, a body.npz; the built-in one if absent."""
    poses: Path | None = None
    """Motion file with the pose and the shape in which the garment lies on the body; the rest pose of the mean shape if
    absent."""
    frame: Whole | None = None
    """Frame of that file, by its number; the first if absent."""
    region: Region | None = None
    """Take this part of the body as the garment."""
    uv: UvChoice = "auto"
    """Keep the mesh's UVs or cut fresh ones; `auto` keeps them if nothing is wrong with them."""
    names: tuple[str, ...] = ()
    """Names of the border loops, the one with the most vertices first; found by their place if absent."""
    follow: Follow = "skin"
    """What moves the garment: the skin beneath it; of one that hangs loose, such as a skirt, the mean of trunk and legs
    around it, weighted by inverse distance; or the root joint alone."""
    uv_is_pattern: bool = False
    """The mesh's UVs are its sewing pattern: registration takes the cloth's lengths from them. Without this they are
    compared with one, and the command says what it found."""
    units: MeshUnits = "auto"
    """Of the mesh; `auto` takes the unit in which it lies on the body, and says it."""
    up: Axis | None = None
    """Axis of the mesh that points up; found by how it lies on the body, and said, if absent."""
    wrap: bool = False
    """Shrink the mesh onto the body and bind each vertex to where it comes to lie, without gaps and crowds: for offset
    images. Without this it is bound to the nearest body point."""
    cage: Path | None = None
    """Curves along which --wrap does it: a .npy with a label for each triangle, which meet there, or a .json
    {"curves": [[vertex, ...], ...]}. Found by panels and joints if absent."""

    def __call__(self) -> int:
        from capture4d import pipeline
        from capture4d.templates.told import told

        config = TemplateConfig(
            self.frame,
            self.region,
            self.uv,
            self.names,
            self.units,
            self.up,
            self.uv_is_pattern,
            self.wrap,
            self.follow,
        )
        result = pipeline.template(
            self.mesh,
            self.output,
            config,
            body=self.body,
            poses=self.poses,
            cage=self.cage,
            overwrite=self.overwrite,
        )
        for note in result.notes:
            print(f"capture4d: {self.mesh}: {note}", file=sys.stderr)
        for line in told(result):
            print(line)
        print(f"template: {result.path}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class RegisterMesh(FileOptions, MeshOptions):
    """Register any template to any scan, two mesh files; writes the result, and its measures as JSON beside it."""

    template: Annotated[Positional[Path], arg(metavar="TEMPLATE")]
    """Mesh to deform: obj, ply, glb, gltf, stl or off. Its vertex order and faces are kept."""
    scan: Annotated[Positional[Path], arg(metavar="SCAN")]
    """Mesh to fit it to: obj, ply, glb, gltf, stl or off; a point cloud gets faces between its points."""
    output: Path
    """Mesh to write: ply, obj, glb or off; the JSON has the same name."""
    landmarks: Path | None = None
    """Text file of pairs, one a line: a template vertex and a scan vertex, counted from 0, or a point of each, six
    coordinates. Needed where the two are too far apart to find each other."""
    config: Annotated[MeshRegistrationConfig, arg(name="")] = field(default_factory=MeshRegistrationConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        result = pipeline.register_mesh(
            self.template, self.scan, self.output, self.config, landmarks=self.landmarks, overwrite=self.overwrite
        )
        said = {"good": "registered", "check": "registered, to check"}.get(result.quality.verdict, "failed")
        print(f"{said}: {self.output}, measures: {self.output.with_suffix('.json')}")
        for note in result.notes:
            print(f"capture4d: {note}", file=sys.stderr)
        if result.estimated:
            print(f"capture4d: {self.scan}: points without faces; normals and faces are estimated", file=sys.stderr)
        quality = result.quality
        if quality.verdict != "good":
            print(f"capture4d: {self.output}: {quality.verdict}: {'; '.join(quality.reasons)}", file=sys.stderr)
        return BAD_RESULT if quality.verdict == "failed" else GOOD


@dataclass(frozen=True, kw_only=True)
class ConvertBody(FileOptions):
    """Convert a body model of the SMPL family, from your own licensed file, to a body.npz for captures."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """SMPL, SMPL-H or SMPL-X model, .npz, or .pkl (read without running its code)."""
    output: Path
    """File to write, as body.npz in a capture folder."""

    def __call__(self) -> int:
        from capture4d.body.smpl import convert_smpl
        from capture4d.files.outputs import new_files

        with new_files([self.output], inputs=[self.file], overwrite=self.overwrite) as workshop:
            convert_smpl(self.file, workshop / self.output.name)
        print(f"body: {self.output}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class ConvertRig(FileOptions):
    """Convert a rig.json to a COLMAP model, or a COLMAP, Metashape or nerfstudio file to a rig.json."""

    source: Annotated[Positional[Path], arg(metavar="SOURCE")]
    """rig.json, a folder with a COLMAP model, a Metashape XML of cameras, or a transforms.json of nerfstudio."""
    output: Path
    """Folder for the model, or rig.json."""
    text: bool = False
    """Write the model as text."""
    scale: Positive = 1.0
    """Metres in a unit of the source: what others solve for has no scale of its own."""

    def __call__(self) -> int:
        from capture4d.cameras.exchange import convert_rig

        left_out = convert_rig(self.source, self.output, text=self.text, scale=self.scale, overwrite=self.overwrite)
        if left_out:
            more = f" and {len(left_out) - 5} more" if len(left_out) > 5 else ""
            print(f"capture4d: {self.source}: left out {', '.join(left_out[:5])}{more}", file=sys.stderr)
        print(f"rig: {self.output}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class ConvertPoses(FileOptions):
    """Convert a motion between poses.npz, AMASS npz and BVH, retargeted to a body where the skeletons differ."""

    input: Annotated[Positional[Path], arg(metavar="IN")]
    """Motion file, .npz or .bvh: poses.npz, AMASS's or other SMPL parameters, BVH; told by what is in it."""
    output: Annotated[Positional[Path], arg(metavar="OUT")]
    """Motion file to write, .npz or .bvh."""
    body: Path | None = None
    """The body that moves, a body.npz; the built-in one if absent."""
    format: Literal["poses", "amass"] = "poses"
    """What kind of .npz to write."""
    fps: Positive | None = None
    """Frame rate to resample to; that of the input if absent. Of an input that tells no rate, its own."""
    names: str = "auto"
    """Whose names a BVH's joints have: `auto` finds out; mixamo, cmu, lafan, rokoko, xsens, smpl, biped, unreal, unity,
    motive, neuron, blender, daz, vicon, mocopi, makehuman; or a JSON file, our joint: their joint."""
    up: Axis | None = None
    """Axis of the input's world that points up, such as z or -y; found if absent."""
    facing: Axis | None = None
    """Axis of a BVH's world that becomes our +Z, where bodies face at rest; found if absent."""

    def __call__(self) -> int:
        from capture4d.body.anny import load_anny
        from capture4d.files.outputs import new_files
        from capture4d.files.records import load_body
        from capture4d.motions.clips import MotionWords
        from capture4d.motions.motion_files import read_motion, told, write_motion

        body = load_body(self.body) if self.body else load_anny()
        words = MotionWords.of(self.names, self.up, self.facing)
        named = Path(self.names) if self.names.lower().endswith(".json") else None
        with new_files([self.output], inputs=[self.input, self.body, named], overwrite=self.overwrite) as workshop:
            poses = read_motion(self.input, body, fps=self.fps, words=words, say=told(self.input))
            write_motion(workshop / self.output.name, body, poses, amass=self.format == "amass")
        print(f"{len(poses.frame_ids)} poses at {poses.fps:g} fps: {self.output}")
        return GOOD
