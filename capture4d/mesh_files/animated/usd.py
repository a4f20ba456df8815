"""USD: a mesh with time samples, its normals and a UsdPreviewSurface with a normal map for each frame; and back.

Metres, Y up; a time code is a frame's number. The shading is what clients agree on: UsdPreviewSurface with a texture
whose file has time samples and a default as well, for Blender drops a texture without one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.files.optional_packages import USD, package_module
from capture4d.files.reading import reading
from capture4d.geometry.mesh import vertex_normals
from capture4d.mesh_files.animated.moving_mesh import CLOTH_COLOUR, MovingMesh
from capture4d.mesh_files.polygons import polygon_mesh
from capture4d.types import Mesh

__all__ = ["read_usd", "usd_faults", "write_usd"]

_SAVED_AFTER = 200
"""Frames until what was set goes to the disk: memory does not grow with the take."""


def write_usd(
    path: Path,
    moving: MovingMesh,
    *,
    name: str = "garment",
    maps: Sequence[str] = (),
    albedo: str | None = None,
    normals: bool = True,
    colour: tuple[float, float, float] = CLOTH_COLOUR,
) -> None:
    """Write a .usdc, .usda or .usd file.

    Args:
        name: of the prim.
        maps: normal map of each frame, +Y, as a path relative to the file.
        albedo: picture of the colours, sRGB, likewise.
        normals: author the area-weighted vertex normals of each frame, so that every client shades alike.
        colour: linear; seen where there is no picture of the colours.
    Raises:
        InputError: usd-core is not installed, or nobody knows the frame rate.
    """
    Usd, UsdGeom, Gf = (package_module(USD, each) for each in ("Usd", "UsdGeom", "Gf"))
    if moving.fps is None:
        raise InputError("expected a frame rate, found none")
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(moving.fps)
    stage.SetFramesPerSecond(moving.fps)
    stage.SetStartTimeCode(int(moving.frame_ids[0]))
    stage.SetEndTimeCode(int(moving.frame_ids[-1]))
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    mesh = _topology(stage, f"/{name}/mesh", moving.mesh, normals)
    if moving.mesh.uv is not None:
        look = _material(stage, f"/{name}/material", mesh, colour)
        if maps or albedo is not None:
            _textures(stage, look, moving.frame_ids.tolist(), maps, albedo)
    points, extent, shading = mesh.GetPointsAttr(), mesh.GetExtentAttr(), mesh.GetNormalsAttr()
    for at, (frame_id, vertices) in enumerate(zip(moving.frame_ids.tolist(), moving.frames(), strict=True)):
        points.Set(_vectors(vertices), frame_id)
        ends = [Gf.Vec3f(*each.tolist()) for each in (vertices.min(axis=0), vertices.max(axis=0))]
        extent.Set(ends, frame_id)
        if normals:
            shading.Set(_vectors(vertex_normals(vertices.astype(np.float64), moving.mesh.faces)), frame_id)
        if at % _SAVED_AFTER == _SAVED_AFTER - 1:
            stage.GetRootLayer().Save()
    stage.GetRootLayer().Save()


def _vectors(values: np.ndarray) -> Any:
    return package_module(USD, "Vt").Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def _topology(stage: Any, place: str, mesh: Mesh, normals: bool) -> Any:
    """What does not move."""
    UsdGeom, Sdf, Vt = (package_module(USD, each) for each in ("UsdGeom", "Sdf", "Vt"))
    made = UsdGeom.Mesh.Define(stage, place)
    made.CreateSubdivisionSchemeAttr("none")
    made.CreateDoubleSidedAttr(True)
    made.CreateOrientationAttr("rightHanded")
    made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    made.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.reshape(-1))))
    made.CreatePointsAttr()
    made.CreateExtentAttr()
    made.CreateNormalsAttr()
    if normals:
        made.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    if mesh.uv is not None:
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        primvar = UsdGeom.PrimvarsAPI(made).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
        places, corner = np.unique(mesh.uv.reshape(-1, 2), axis=0, return_inverse=True)
        primvar.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(places)))
        primvar.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(corner.reshape(-1), np.int32)))
    return made


def _material(stage: Any, place: str, mesh: Any, colour: tuple[float, float, float]) -> str:
    """A surface of cloth; its place."""
    UsdShade, Sdf, Gf = (package_module(USD, each) for each in ("UsdShade", "Sdf", "Gf"))
    types = Sdf.ValueTypeNames
    look = UsdShade.Material.Define(stage, place)
    surface = UsdShade.Shader.Define(stage, f"{place}/preview")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("diffuseColor", types.Color3f).Set(Gf.Vec3f(*colour))
    surface.CreateInput("roughness", types.Float).Set(0.85)
    look.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(look)
    return place


def _textures(stage: Any, place: str, frame_ids: Sequence[int], maps: Sequence[str], albedo: str | None) -> None:
    """The normal map of each frame, and the colours, on a surface."""
    UsdShade, Sdf, Gf = (package_module(USD, each) for each in ("UsdShade", "Sdf", "Gf"))
    types, surface = Sdf.ValueTypeNames, UsdShade.Shader(stage.GetPrimAtPath(f"{place}/preview"))
    reader = UsdShade.Shader.Define(stage, f"{place}/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    places = reader.CreateOutput("result", types.Float2)

    def texture(name: str, first: str, space: str) -> Any:
        made = UsdShade.Shader.Define(stage, f"{place}/{name}")
        made.CreateIdAttr("UsdUVTexture")
        made.CreateInput("file", types.Asset).Set(first)
        made.CreateInput("sourceColorSpace", types.Token).Set(space)
        for side in ("wrapS", "wrapT"):
            made.CreateInput(side, types.Token).Set("clamp")
        made.CreateInput("st", types.Float2).ConnectToSource(places)
        return made

    if maps:
        normal = texture("normal", maps[0], "raw")
        for frame_id, each in zip(frame_ids, maps, strict=True):
            normal.GetInput("file").Set(each, frame_id)
        normal.CreateInput("scale", types.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
        normal.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        surface.CreateInput("normal", types.Normal3f).ConnectToSource(normal.CreateOutput("rgb", types.Float3))
    if albedo is not None:
        colours = texture("albedo", albedo, "sRGB")
        surface.GetInput("diffuseColor").ConnectToSource(colours.CreateOutput("rgb", types.Float3))


def usd_faults(path: Path) -> list[str]:
    """What USD's own validators say is wrong with a file and what it names, a line each."""
    Usd, UsdValidation = (package_module(USD, each) for each in ("Usd", "UsdValidation"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [f"{each.GetName()}: {each.GetMessage()}" for each in found]


# --- and back ----------------------------------------------------------------------------------------------------


def read_usd(path: Path) -> MovingMesh:
    """The mesh with the most vertices in a file, in the world, metres and Y up, where its prims put it.

    Raises:
        InputError: usd-core is not installed, the file is damaged, or holds no mesh that moves with one topology.
    """
    Usd, UsdGeom, Tf = (package_module(USD, each) for each in ("Usd", "UsdGeom", "Tf"))
    with reading(path, "USD file"):
        path.stat()
        try:
            stage = Usd.Stage.Open(str(path))
        except Tf.ErrorException as error:
            raise InputError(f"not a USD file, or damaged ({str(error)[:200]})") from None
        meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
        if not meshes:
            raise InputError("expected a mesh, found none")
        mesh = max(meshes, key=_size)
        times = mesh.GetPointsAttr().GetTimeSamples() or [stage.GetStartTimeCode()]
        if mesh.GetFaceVertexIndicesAttr().GetNumTimeSamples() > 1:
            raise InputError("expected one topology in all frames, found one that changes")
        ids = np.rint(times).astype(np.int32)
        if np.abs(ids - np.asarray(times)).max() > 1e-3:
            raise InputError("expected time codes that are whole frames, found others")
        place = str(mesh.GetPath())
        frames = partial(_positions, path, place, times)
        shape = _shape(mesh, times[0], next(frames()))
        has_normals = mesh.GetNormalsInterpolation() == "vertex" and mesh.GetNormalsAttr().HasAuthoredValue()
        fps = float(stage.GetTimeCodesPerSecond())
        return MovingMesh(shape, ids, fps, frames, partial(_normals, path, place, times) if has_normals else None)


def _size(mesh: Any) -> int:
    attribute = mesh.GetPointsAttr()
    samples = attribute.GetTimeSamples()
    return len((attribute.Get(samples[0]) if samples else attribute.Get()) or ())


def _shape(mesh: Any, time: float, vertices: np.ndarray) -> Mesh:
    """Triangles and UVs, whatever interpolation these have."""
    UsdGeom = package_module(USD, "UsdGeom")
    sizes = np.array(mesh.GetFaceVertexCountsAttr().Get(time), np.int64)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(time), np.int64)
    if sizes.sum() != len(corners):
        raise InputError(f"expected {sizes.sum()} corners of faces, found {len(corners)}")
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    uv = None
    if primvar and primvar.HasValue():
        flat = np.array(primvar.ComputeFlattened(time), np.float32).reshape(-1, 2)
        by_vertex = primvar.GetInterpolation() in ("vertex", "varying")
        flat = flat[corners] if by_vertex and len(flat) > corners.max(initial=-1) else flat
        uv = flat if len(flat) == len(corners) else None
    if mesh.GetOrientationAttr().Get() == "leftHanded":
        order = np.concatenate(
            [np.arange(end - size, end)[::-1] for size, end in zip(sizes, sizes.cumsum(), strict=True)]
        )
        corners, uv = corners[order], None if uv is None else uv[order]
    return polygon_mesh(vertices, corners, sizes, uv)[0].mesh


def _meshes(path: Path, place: str, times: Sequence[float]) -> Iterator[tuple[float, Any]]:
    """The mesh at each time. The file is opened again now and then, for what was read of it stays in memory."""
    Usd, UsdGeom = (package_module(USD, each) for each in ("Usd", "UsdGeom"))
    for start in range(0, len(times), _SAVED_AFTER):
        stage = Usd.Stage.Open(str(path))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(place))
        for time in times[start : start + _SAVED_AFTER]:
            yield time, mesh
        del mesh, stage


def _positions(path: Path, place: str, times: Sequence[float]) -> Iterator[np.ndarray]:
    """Points in the world, in metres, Y up."""
    UsdGeom = package_module(USD, "UsdGeom")
    for time, mesh in _meshes(path, place, times):
        stage = mesh.GetPrim().GetStage()
        unit = UsdGeom.GetStageMetersPerUnit(stage)
        is_z_up = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
        points = np.array(mesh.GetPointsAttr().Get(time), np.float32).reshape(-1, 3)
        matrix = np.array(UsdGeom.Xformable(mesh).ComputeLocalToWorldTransform(time))  # of row vectors
        if is_z_up or unit != 1 or not np.array_equal(matrix, np.eye(4)):
            world = unit * (points.astype(np.float64) @ matrix[:3, :3] + matrix[3, :3])
            points = (world[:, [0, 2, 1]] * (1, 1, -1) if is_z_up else world).astype(np.float32)
        del stage
        yield points


def _normals(path: Path, place: str, times: Sequence[float]) -> Iterator[np.ndarray]:
    for time, mesh in _meshes(path, place, times):
        yield np.array(mesh.GetNormalsAttr().Get(time), np.float32).reshape(-1, 3)
