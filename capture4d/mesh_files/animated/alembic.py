"""Alembic: a mesh with a sample for each frame and its normals; and back. Metres, Y up, seconds = frame / rate.

Alembic winds faces clockwise. The package is alembic3d, an unofficial build of the official Python bindings.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.errors import InputError
from capture4d.files.optional_packages import ALEMBIC, package_module
from capture4d.files.reading import reading
from capture4d.geometry.mesh import vertex_normals
from capture4d.mesh_files.animated.moving_mesh import MovingMesh
from capture4d.mesh_files.polygons import polygon_mesh
from capture4d.types import Mesh

__all__ = ["read_alembic", "write_alembic"]

_AT_ONCE = 200


def write_alembic(path: Path, moving: MovingMesh, *, name: str = "garment", normals: bool = True) -> None:
    """Write a .abc file.

    Args:
        normals: author the area-weighted vertex normals of each frame.
    Raises:
        InputError: alembic3d is not installed, or nobody knows the frame rate.
    """
    Abc, AbcGeom = (package_module(ALEMBIC, each) for each in ("Abc", "AbcGeom"))
    times = moving.times_s()
    archive = Abc.OArchive(str(path))
    sampling = archive.addTimeSampling(_time_sampling(moving, times))
    made = AbcGeom.OPolyMesh(AbcGeom.OXform(archive.getTop(), name), "mesh")
    schema = made.getSchema()
    schema.setTimeSampling(sampling)
    faces = moving.mesh.faces
    topology = [_integers(faces[:, ::-1].reshape(-1)), _integers(np.full(len(faces), 3))]
    if moving.mesh.uv is not None:
        uv = _vectors("V2f", moving.mesh.uv[:, ::-1].reshape(-1, 2))
        topology.append(AbcGeom.OV2fGeomParamSample(uv, AbcGeom.GeometryScope.kFacevaryingScope))
    for vertices in moving.frames():
        sample = [_vectors("V3f", vertices), *topology]
        if normals:
            shading = _vectors("V3f", vertex_normals(vertices.astype(np.float64), faces))
            if len(topology) < 3:  # arguments go by their place
                sample.append(AbcGeom.OV2fGeomParamSample())
            sample.append(AbcGeom.ON3fGeomParamSample(shading, AbcGeom.GeometryScope.kVertexScope))
        schema.set(AbcGeom.OPolyMeshSchemaSample(*sample))
    del schema, made, archive  # which closes the file


def _time_sampling(moving: MovingMesh, times: np.ndarray) -> Any:
    """Evenly from the first frame on, or a time for each frame."""
    core = package_module(ALEMBIC, "AbcCoreAbstract")
    steps = np.diff(moving.frame_ids)
    if len(steps) and (steps != steps[0]).any():
        listed = core.TimeVector()
        for time in times.tolist():
            listed.append(time)
        return core.TimeSampling(core.TimeSamplingType(core.AcyclicFlag.kAcyclic), listed)
    assert moving.fps is not None
    return core.TimeSampling(float(steps[0] if len(steps) else 1) / moving.fps, float(times[0]))


def _imath() -> Any:
    package_module(ALEMBIC, "Abc")  # which says what is missing, and brings it
    return importlib.import_module("imath")


def _vectors(kind: str, values: np.ndarray) -> Any:
    """From a buffer: a list takes hundreds of times as long."""
    return getattr(_imath(), f"{kind}ArrayFromBuffer")(np.ascontiguousarray(values, np.float32))


def _integers(values: np.ndarray) -> Any:
    return _imath().IntArrayFromBuffer(np.ascontiguousarray(values, np.int32))


# --- and back ----------------------------------------------------------------------------------------------------


def read_alembic(path: Path, fps: float | None = None) -> MovingMesh:
    """The mesh with the most vertices in a file. Transforms are not read: a file in which they do anything is refused.

    Args:
        fps: frames a second; that of the file's own samples, taken for one a frame, if None.
    Raises:
        InputError: alembic3d is not installed, the file is damaged, or holds no mesh that moves with one topology.
    """
    package_module(ALEMBIC, "Abc")
    with reading(path, "Alembic file"):
        path.stat()
        try:
            schemas = _schemas(path)
        except InputError:
            raise
        except Exception as error:  # the bindings hand on C++ exceptions of several kinds
            raise InputError(f"not an Alembic file, or damaged ({str(error)[:120]})") from None
        if not schemas:
            raise InputError("expected a mesh, found none")
        sizes = [len(each.getValue(next(_selectors(each))).getPositions()) for each in schemas]
        at = sizes.index(max(sizes))
        schema, frames = schemas[at], partial(_positions, path, at)
        count, sampling = schema.getNumSamples(), schema.getTimeSampling()
        times = np.array([sampling.getSampleTime(each) for each in range(count)])
        rate = fps or (1 / np.diff(times).min() if count > 1 else 24.0)
        ids = np.rint(times * rate)
        if np.abs(ids - times * rate).max(initial=0) > 0.1:
            raise InputError(f"expected times of frames at {rate:g} a second, found others")
        shape = _shape(schema.getValue(next(_selectors(schema))), schema, next(frames()))
        normals = partial(_normals, path, at) if schema.getNormalsParam().valid() else None
        return MovingMesh(shape, ids.astype(np.int32), float(rate), frames, normals)


def _schemas(path: Path) -> list[Any]:
    """Of the meshes in a file, always in one order."""
    Abc, AbcGeom = (package_module(ALEMBIC, each) for each in ("Abc", "AbcGeom"))
    found = _meshes(Abc.IArchive(str(path)), AbcGeom)
    return [AbcGeom.IPolyMesh(each.getParent(), each.getName()).getSchema() for each in found]


def _meshes(archive: Any, AbcGeom: Any) -> Iterator[Any]:
    """Objects that are meshes; one that hangs from a transform that does anything is refused."""
    waiting = [archive.getTop()]
    while waiting:
        each = waiting.pop()
        for at in range(each.getNumChildren()):
            child = each.getChild(at)
            waiting.append(child)
            if AbcGeom.IPolyMesh.matches(child.getMetaData()):
                yield child
            elif AbcGeom.IXform.matches(child.getMetaData()):
                schema = AbcGeom.IXform(each, child.getName()).getSchema()
                if schema.getNumOps() and not schema.isConstantIdentity():
                    raise InputError(
                        f"'{child.getName()}': expected no transform, found one; freeze it and export again"
                    )


def _shape(sample: Any, schema: Any, vertices: np.ndarray) -> Mesh:
    sizes = _array(sample.getFaceCounts()).astype(np.int64)
    corners = _array(sample.getFaceIndices()).astype(np.int64)
    if sizes.sum() != len(corners):
        raise InputError(f"expected {sizes.sum()} corners of faces, found {len(corners)}")
    uv, param = None, schema.getUVsParam()
    if param.valid():
        expanded = param.getExpandedValue()
        values = _array(expanded.getVals())
        uv = values if len(values) == len(corners) else values[corners] if len(values) == len(vertices) else None
    ends = sizes.cumsum()
    order = np.repeat(2 * ends - sizes, sizes) - 1 - np.arange(len(corners))  # each face the other way round
    return polygon_mesh(vertices, corners[order], sizes, None if uv is None else uv[order])[0].mesh


def _positions(path: Path, at: int) -> Iterator[np.ndarray]:
    for schema, selector in _samples(path, at):
        sample = schema.getValue(selector)  # whose memory the positions are
        yield _array(sample.getPositions())


def _normals(path: Path, at: int) -> Iterator[np.ndarray]:
    for schema, selector in _samples(path, at):
        sample = schema.getNormalsParam().getExpandedValue(selector)
        yield _array(sample.getVals())


def _samples(path: Path, at: int) -> Iterator[tuple[Any, Any]]:
    """The mesh with this number, and a selector of each of its samples. The file is opened again now and then, for what
    was read of it stays in memory."""
    selectors = list(_selectors(_schemas(path)[at]))
    for start in range(0, len(selectors), _AT_ONCE):
        schema = _schemas(path)[at]
        for selector in selectors[start : start + _AT_ONCE]:
            yield schema, selector
        del schema


def _selectors(schema: Any) -> Iterator[Any]:
    """Of each sample, by its time: whole numbers are taken for seconds by these bindings."""
    Abc, sampling = package_module(ALEMBIC, "Abc"), schema.getTimeSampling()
    for at in range(schema.getNumSamples()):
        yield Abc.ISampleSelector(float(sampling.getSampleTime(at)))


def _array(values: Any) -> np.ndarray:
    return np.array(memoryview(values))
