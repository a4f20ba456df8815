"""Arrays in, arrays out: one call for one result, without a folder. `capture4d.register_mesh` and its like.

Meshes may be ours, what `read_mesh` returned, a pair (vertices, faces), or anything with `.vertices` and `.faces`, such
as trimesh's; vertices of any float type, faces of any integer type, as arrays or lists.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from capture4d.captures.work_folder import WorkFolder, open_work
from capture4d.errors import InputError
from capture4d.types import Garment, Mesh, RegisteredSequence
from registration.config import MeshRegistrationConfig
from registration.register_mesh import MeshRegistration
from registration.register_mesh import register_mesh as register_normalised

if TYPE_CHECKING:
    from retarget.animation.garment_model import GarmentModel
    from retarget.mixture.styled_garment import StyledGarment

__all__ = ["as_mesh", "load_garment_model", "load_registered", "load_styled_garment", "register_mesh", "wrinkle_map"]


def register_mesh(
    template: Any, scan: Any, *, colours: Any = None, config: MeshRegistrationConfig | None = None
) -> MeshRegistration:
    """Deform a template onto a scan.

    Args:
        template: mesh of V vertices, in any unit; its vertex order and faces are kept.
        scan: mesh in the same unit.
        colours: (S, 3) uint8, sRGB of the scan's vertices; needed where `config` names a paint on its borders.
    Returns:
        `.vertices` (V, 3) float32 in the unit of the input, `.quality.verdict` ("good", "check" or "failed") and
        `.quality.reasons`.
    Raises:
        InputError: a mesh is empty or not finite, or the two cannot be of one unit.
    References:
        DeepWrinkles (ECCV 2018), Eq. 1 and 2.
    """
    from capture4d.extraction.garment import painted_border

    return register_normalised(
        as_mesh(template, "template"),
        as_mesh(scan, "scan"),
        colours=None if colours is None else np.asarray(colours, np.uint8),
        config=config or MeshRegistrationConfig(),
        find_border=painted_border,
    )


def load_registered(work: WorkFolder | str | Path) -> RegisteredSequence:
    """The registered sequence of a work folder: `.vertices` (T, V, 3) float32, metres, read from disk as they are
    touched, of the frames `.frame_ids` (T,), with `.garment.template.faces`.

    Raises:
        InputError: the folder holds no finished registration.
    """
    opened = work.now() if isinstance(work, WorkFolder) else open_work(work)
    _ = opened.registered_digest
    return opened.registered


def load_garment_model(path: str | Path, *, device: str = "cpu") -> "GarmentModel":
    """What `fit` wrote, ready to be moved: `.vertices(poses, beta)` is the garment on a person in motion.

    Args:
        path: WORK, WORK/retarget, or the blendshapes.safetensors in it.
        device: where torch computes.
    Raises:
        InputError: a file is missing, damaged, or belongs to another model.
    """
    from retarget.animation.garment_model import load_garment_model as load

    return load(path, device=device)


def load_styled_garment(path: str | Path) -> "StyledGarment":
    """What `fit-styles` wrote, ready to be worn: `.vertices(poses, beta, style)` is the garment of a style on a person.

    Args:
        path: the model's folder.
    Raises:
        InputError: a file is missing, damaged, or belongs to another model.
    """
    from retarget.mixture.model_files import load_styled_garment as load

    return load(Path(path))


def wrinkle_map(model: str | Path, vertices: Any, *, template: Garment | None = None) -> np.ndarray:
    """The normal map with wrinkles that a trained network gives a posed garment: what `wrinkles apply` writes.

    Args:
        model: folder that `wrinkles train` wrote, or its generator.safetensors.
        vertices: (V, 3) of the template that the network was trained on, posed, metres; or (T, V, 3), several frames.
        template: a garment of that template, for models of early versions, which kept none.
    Returns:
        (S, S, 3) or (T, S, S, 3) float32: unit normals in tangent space, OpenGL's +Y; (0, 0, 1) where the map shows
        nothing. `(map + 1) / 2` are the colours of an image.
    Raises:
        InputError: there is no such model, or it is of another template.
    References:
        DeepWrinkles (ECCV 2018), section 4.
    """
    from wrinkles.normal_maps.wrinkle_maps import wrinkle_map as made

    return made(model, np.asarray(vertices, np.float32), template=template)


def as_mesh(value: Any, name: str = "mesh") -> Mesh:
    """Whatever is a mesh to its owner, as ours: float32 and int32, without UVs unless it brings our own.

    Raises:
        InputError: it has no vertices and faces, or not (V, 3) numbers and (F, 3) whole numbers.
    """
    inner = getattr(value, "mesh", value)
    if isinstance(inner, Mesh):
        return inner
    if hasattr(inner, "vertices") and hasattr(inner, "faces"):
        inner = inner.vertices, inner.faces
    try:
        vertices, faces = (np.asarray(part) for part in inner)
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: expected a mesh, a pair (vertices, faces), or something with .vertices and .faces, "
            f"found {type(value).__name__}"
        ) from None
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
        raise InputError(f"{name}: expected vertices of shape (V, 3), found {vertices.dtype} of {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise InputError(f"{name}: expected faces of shape (F, 3), found {faces.dtype} of {faces.shape}")
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise InputError(
            f"{name}: expected faces of {len(vertices)} vertices, found {faces.min()} to {faces.max()} in them"
        )
    if not len(faces):
        raise InputError(f"{name}: expected a mesh with faces, found none")
    if not np.isfinite(vertices).all():
        raise InputError(f"{name}: expected finite vertices, found NaN or infinity")
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))
