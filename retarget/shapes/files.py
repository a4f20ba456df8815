"""Blendshape models as safetensors: everything that puts the garment on a body, in one file that runs no code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from capture4d.files.border_loops import on_open_edges
from capture4d.files.json_values import number, text, texts
from capture4d.files.reading import reading
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.types import BlendshapeModel, Garment, Mesh

__all__ = ["load_blendshapes", "save_blendshapes"]

_KIND = "capture4d blendshapes"
_OPTIONAL = ("embedding_faces", "embedding_barycentric", "skin_weights", "body_shape")


def save_blendshapes(path: str | Path, model: BlendshapeModel) -> None:
    garment = model.garment
    optional = {name: getattr(garment, name) for name in _OPTIONAL} | {"template_uv": garment.template.uv}
    tensors = {
        "template_vertices": garment.template.vertices,
        "template_faces": garment.template.faces,
        "mean": model.mean,
        "basis": model.basis,
        "std": model.std,
        **{name: array for name, array in optional.items() if array is not None},
        **{f"loop_{name}": loop for name, loop in garment.loops.items()},
    }
    # safetensors sorts its tensors; the order of the loops is kept in the note.
    note = {"loops": list(garment.loops), "joint_names": model.joint_names, "fps": model.fps, "licence": model.licence}
    write_tensors(path, _KIND, tensors, note)


def load_blendshapes(path: str | Path) -> BlendshapeModel:
    """Raises InputError that names the file, whatever is wrong with it."""
    file = read_tensors(path, _KIND)
    with reading(path, "blendshape model"):
        template = Mesh(file["template_vertices"], file["template_faces"], file.get("template_uv"))
        optional: dict[str, Any] = {name: file.get(name) for name in _OPTIONAL}
        garment = Garment(
            template,
            loops={name: file[f"loop_{name}"] for name in texts(file.entry("loops"), "loops")},
            **optional,
        )
        return BlendshapeModel(
            on_open_edges(garment),
            mean=file["mean"],
            basis=file["basis"],
            std=file["std"],
            joint_names=texts(file.entry("joint_names"), "joint_names"),
            fps=number(file.entry("fps"), "fps"),
            licence=text(file.entry("licence"), "licence"),
        )
