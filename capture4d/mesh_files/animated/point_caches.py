"""Point caches, vertices alone in every frame: PC2 (3ds Max, Blender) and MDD (LightWave, Blender), and back.

They belong to a mesh file with the same vertex order; faces and UVs are its.

References: PC2: 32 bytes "POINTCACHE2\\0", version 1, points, first frame, frames a sample, samples; little-endian.
MDD: samples, points, a time in seconds each; big-endian. As Blender's Mesh Cache modifier reads them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.atomic import write_chunks
from capture4d.files.reading import reading
from capture4d.mesh_files.animated.moving_mesh import MovingMesh, even_step
from capture4d.types import Mesh

__all__ = ["read_mdd", "read_pc2", "write_mdd", "write_pc2"]

_PC2 = struct.Struct("<12siiffi")
_MDD = struct.Struct(">2i")


def write_pc2(path: Path, moving: MovingMesh) -> None:
    """
    Raises:
        InputError: the frames are not evenly spaced.
    """
    step = even_step(moving.frame_ids, "pc2")
    first, count, verts = int(moving.frame_ids[0]), len(moving.frame_ids), len(moving.mesh.vertices)
    header = _PC2.pack(b"POINTCACHE2\0", 1, verts, float(first), float(step), count)
    write_chunks(path, _chunks(header, moving, "<f4"))


def write_mdd(path: Path, moving: MovingMesh) -> None:
    """
    Raises:
        InputError: the frames are not evenly spaced, or nobody knows their rate.
    """
    even_step(moving.frame_ids, "mdd")
    header = _MDD.pack(len(moving.frame_ids), len(moving.mesh.vertices)) + moving.times_s().astype(">f4").tobytes()
    write_chunks(path, _chunks(header, moving, ">f4"))


def _chunks(header: bytes, moving: MovingMesh, dtype: str) -> Iterator[bytes]:
    yield header
    for each in moving.frames():
        yield np.ascontiguousarray(each, dtype).tobytes()


def read_pc2(path: Path, mesh: Mesh) -> MovingMesh:
    """
    Args:
        mesh: whose vertices these are.
    Raises:
        InputError: the file is damaged, or has another number of vertices.
    """
    with reading(path, "PC2 file"):
        with path.open("rb") as file:
            head = file.read(_PC2.size)
        if len(head) < _PC2.size or not head.startswith(b"POINTCACHE2\0"):
            raise InputError("expected a PC2 file, which begins with POINTCACHE2, found something else")
        _, _, verts, first, step, count = _PC2.unpack(head)
        _require(path, mesh, verts, count, _PC2.size)
        if not (step >= 1 and step == int(step) and first == int(first) and 0 <= first + step * count < 2**31):
            raise InputError(f"expected whole frames, found a first frame of {first:g} and steps of {step:g}")
        ids = (int(first) + int(step) * np.arange(count)).astype(np.int32)
        return MovingMesh(mesh, ids, None, partial(_rows, path, _PC2.size, verts, count, "<f4"))


def read_mdd(path: Path, mesh: Mesh, fps: float) -> MovingMesh:
    """
    Args:
        mesh: whose vertices these are.
        fps: frames a second; the file has seconds, in 32 bits.
    Raises:
        InputError: the file is damaged, has another number of vertices, or its times are no frames of that rate.
    """
    with reading(path, "MDD file"):
        with path.open("rb") as file:
            head = file.read(_MDD.size)
            if len(head) < _MDD.size:
                raise InputError("expected an MDD file, found a shorter one than its header")
            count, verts = _MDD.unpack(head)
            _require(path, mesh, verts, count, _MDD.size + 4 * max(count, 0))
            frames = np.frombuffer(file.read(4 * count), ">f4").astype(np.float64) * fps
        ids = np.rint(frames)
        if not (np.abs(frames - ids) <= 0.1).all() or not (np.abs(ids) < 2**31).all():
            raise InputError(f"expected times of frames at {fps:g} a second, found others")
        start = _MDD.size + 4 * count
        return MovingMesh(mesh, ids.astype(np.int32), fps, partial(_rows, path, start, verts, count, ">f4"))


def _require(path: Path, mesh: Mesh, verts: int, count: int, start: int) -> None:
    if verts != len(mesh.vertices):
        raise InputError(f"expected the {len(mesh.vertices)} vertices of the mesh, found {verts}")
    there, needed = path.stat().st_size, start + 12 * verts * max(count, 0)
    if count < 1 or there != needed:
        raise InputError(f"expected {needed} bytes for {count} frames, found {there}")


def _rows(path: Path, start: int, verts: int, count: int, dtype: str) -> Iterator[np.ndarray]:
    with path.open("rb") as file:
        file.seek(start)
        for _ in range(count):
            data = file.read(12 * verts)
            yield np.frombuffer(data, dtype).astype(np.float32).reshape(verts, 3)
