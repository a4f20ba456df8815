"""Blendshape models and tensor files: back as they were, and damage in one line."""

from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.types import BlendshapeModel, Garment, Mesh
from retarget.shapes.files import load_blendshapes, save_blendshapes


def some_model(*, uv: bool = True) -> BlendshapeModel:
    rng = np.random.default_rng(0)
    vertices = rng.standard_normal((5, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]], np.int32)
    template = Mesh(vertices, faces, rng.random((3, 3, 2)).astype(np.float32) if uv else None)
    loops = {"neck": np.array([2, 1, 0, 4, 3], np.int32), "hem": np.array([4, 0, 1, 2, 3], np.int32)}
    garment = Garment(
        template,
        loops,
        np.array([0, 1, 2, 0, 1], np.int32),
        rng.dirichlet(np.ones(3), 5).astype(np.float32),
        np.tile(np.array([0.25, 0.75], np.float32), (5, 1)),
        np.array([1.5, -0.5], np.float32),
    )
    basis = rng.standard_normal((2, 5, 3)).astype(np.float32)
    return BlendshapeModel(
        garment, vertices, basis, np.array([2, 1], np.float32), ("root", "arm"), 59.94, "for tests; näheres: nobody"
    )


@pytest.mark.parametrize("uv", [True, False])
def test_a_model_comes_back_whole(tmp_path: Path, uv: bool) -> None:
    model = some_model(uv=uv)
    save_blendshapes(tmp_path / "a.safetensors", model)
    again = load_blendshapes(tmp_path / "a.safetensors")
    for name in ("mean", "basis", "std"):
        np.testing.assert_array_equal(getattr(again, name), getattr(model, name))
    for name in ("embedding_faces", "embedding_barycentric", "skin_weights", "body_shape"):
        np.testing.assert_array_equal(getattr(again.garment, name), getattr(model.garment, name))
    assert list(again.garment.loops) == ["neck", "hem"]
    np.testing.assert_array_equal(again.garment.loops["hem"], [4, 0, 1, 2, 3])
    assert (again.joint_names, again.fps, again.licence) == (model.joint_names, model.fps, model.licence)
    if uv:
        np.testing.assert_array_equal(again.garment.template.uv, model.garment.template.uv)
    else:
        assert again.garment.template.uv is None
    save_blendshapes(tmp_path / "b.safetensors", again)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_a_model_wants_weights_for_its_joints() -> None:
    model = some_model()
    with pytest.raises(InputError, match="expected skin weights for 3 joints, found weights for 2"):
        BlendshapeModel(model.garment, model.mean, model.basis, model.std, ("a", "b", "c"), 60.0)


def test_every_cut_of_a_file_is_one_line(tmp_path: Path) -> None:
    save_blendshapes(tmp_path / "whole.safetensors", some_model())
    whole = (tmp_path / "whole.safetensors").read_bytes()
    for length in (0, 4, 8, 60, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.safetensors").write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"cut\.safetensors: ") as found:
            load_blendshapes(tmp_path / "cut.safetensors")
        assert "\n" not in str(found.value)
    with pytest.raises(InputError, match="no such file"):
        load_blendshapes(tmp_path / "none.safetensors")


def test_files_of_another_kind_are_refused(tmp_path: Path) -> None:
    write_tensors(tmp_path / "x.safetensors", "one kind", {"a": np.zeros(3)}, {"why": "so"})
    assert read_tensors(tmp_path / "x.safetensors", "one kind").entry("why") == "so"
    with pytest.raises(InputError, match="expected another, found one kind"):
        read_tensors(tmp_path / "x.safetensors", "another")
    with pytest.raises(InputError, match="expected a tensor 'b', found a"):
        read_tensors(tmp_path / "x.safetensors", "one kind")["b"]
