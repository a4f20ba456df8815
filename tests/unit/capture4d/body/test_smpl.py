"""The SMPL family's files become bodies, and its relatives, or what is no body, one line."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.skinning import skin, with_pose, with_shape
from capture4d.body.smpl import read_smpl
from capture4d.errors import InputError
from capture4d.files.atomic import write_npz
from capture4d.motions.retargeting import SMPL_TREE
from tests.unit.capture4d.body.test_skinning import some_pose


def smpl_fields(seed: int = 0, joints: int = 24) -> dict[str, np.ndarray]:
    rng, verts = np.random.default_rng(seed), 30
    weights = rng.dirichlet(np.ones(joints), verts)
    return {
        "v_template": rng.normal(size=(verts, 3)),
        "shapedirs": rng.normal(size=(verts, 3, 10)),
        "posedirs": 0.01 * rng.normal(size=(verts, 3, 9 * (joints - 1))),
        "J_regressor": rng.dirichlet(np.ones(verts), joints),
        "weights": weights,
        "kintree_table": np.stack([np.concatenate([[2**32 - 1], np.arange(joints - 1)]), np.arange(joints)]),
        "f": rng.integers(0, verts, (20, 3)),
    }


def test_smpl_npz_and_pickle_give_the_same_body(tmp_path: Path) -> None:
    fields = smpl_fields()
    write_npz(tmp_path / "body.npz", **fields)
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(fields, protocol=2))
    first, second = read_smpl(tmp_path / "body.npz"), read_smpl(tmp_path / "body.pkl")
    np.testing.assert_array_equal(first.joints, second.joints)
    shaped = with_shape(first, np.full(10, 0.3))
    expected = fields["v_template"] + fields["shapedirs"] @ np.full(10, 0.3)
    np.testing.assert_allclose(shaped.vertices, expected, atol=1e-5)
    np.testing.assert_allclose(shaped.joints, fields["J_regressor"] @ expected, atol=1e-5)


def test_smpl_pose_correctives_vanish_at_rest_and_act_elsewhere(tmp_path: Path) -> None:
    fields = smpl_fields()
    write_npz(tmp_path / "body.npz", **fields)
    body = read_smpl(tmp_path / "body.npz")
    shaped = with_shape(body, np.zeros(0))
    identity = np.repeat(np.eye(3)[None], 24, axis=0)
    np.testing.assert_allclose(with_pose(shaped, identity, np.zeros(3)).vertices(), shaped.vertices, atol=1e-12)
    pose = some_pose(body, 0.3)
    posed = with_pose(shaped, pose, np.zeros(3))
    offset = fields["posedirs"] @ (pose[1:] - np.eye(3)).ravel()
    expected = skin(shaped.vertices + offset, body.skin_weights, posed.transforms)
    np.testing.assert_allclose(posed.vertices(), expected, atol=1e-6)


class _Payload:
    def __reduce__(self):  # what a hostile pickle would do
        return (Path.touch, (Path("owned"),))


def test_pickle_with_anything_but_arrays_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "body.pkl").write_bytes(pickle.dumps({**smpl_fields(), "extra": _Payload()}))
    with pytest.raises(InputError, match=r"body\.pkl: expected only arrays in the pickle, found"):
        read_smpl(tmp_path / "body.pkl")
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize(("joints", "last"), [(24, "right_hand"), (52, "joint_51"), (55, "joint_54")])
def test_the_joints_that_the_family_shares_have_its_names(joints: int, last: str, tmp_path: Path) -> None:
    write_npz(tmp_path / "body.npz", **smpl_fields(joints=joints))
    names = read_smpl(tmp_path / "body.npz").joint_names
    assert names[:22] == tuple(SMPL_TREE)
    assert names[-1] == last
    assert len(set(names)) == joints


def test_what_is_no_array_of_numbers_is_passed_over(tmp_path: Path) -> None:
    np.savez(tmp_path / "body.npz", **smpl_fields(), note="by hand", part2num=np.array({"pelvis": 0}, object))
    assert len(read_smpl(tmp_path / "body.npz").joints) == 24
    fields = smpl_fields()
    fields["weights"] = fields["weights"].astype(object)
    np.savez(tmp_path / "body.npz", **fields)
    with pytest.raises(InputError, match="found no weights"):
        read_smpl(tmp_path / "body.npz")


def test_missing_parts_are_named(tmp_path: Path) -> None:
    fields = smpl_fields()
    del fields["weights"]
    write_npz(tmp_path / "body.npz", **fields)
    with pytest.raises(InputError, match=r"body\.npz: expected an SMPL-family body, found no weights"):
        read_smpl(tmp_path / "body.npz")


RELATIVES = {
    "STAR": ({"posedirs": np.zeros((30, 3, 93))}, 24, "expected 207 posedirs for 24 joints, found 93: STAR"),
    "MANO": ({}, 16, "found 16 joints, those of MANO, a hand"),
    "FLAME": ({}, 5, "found 5 joints, those of FLAME, a head"),
    "SMAL": ({}, 35, "found 35 joints, those of SMAL, an animal"),
    "SUPR": ({"posedirs": np.zeros((30, 3, 300))}, 75, "found 300: STAR or SUPR"),
    "SKEL": ({"skel_template_v": np.zeros((9, 3))}, 24, "found SKEL, whose joints are others"),
    "nobody": ({}, 7, "expected SMPL (24 joints), SMPL-H (52) or SMPL-X (55), found 7 joints"),
}


@pytest.mark.parametrize("name", RELATIVES)
@pytest.mark.parametrize("ending", [".npz", ".pkl"])
def test_relatives_are_refused_by_name(name: str, ending: str, tmp_path: Path) -> None:
    change, joints, said = RELATIVES[name]
    fields = {**smpl_fields(joints=joints), **change}
    path = tmp_path / f"body{ending}"
    if ending == ".npz":
        write_npz(path, **fields)
    else:
        path.write_bytes(pickle.dumps(fields, protocol=5))
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read_smpl(path)
    assert caught.value.where == str(path)


def changed(name: str, at: tuple[int, ...], value: float) -> dict[str, np.ndarray]:
    array = smpl_fields()[name].copy()
    array[at] = value
    return {name: array}


GOOD = smpl_fields()
WRONG = {
    "a regressor of sums": ({"J_regressor": 2 * GOOD["J_regressor"]}, "J_regressor that sum to 1, found 2"),
    "a regressor on its side": ({"J_regressor": GOOD["J_regressor"].T}, "expected J_regressor of shape (24, 30)"),
    "negative weights": (changed("weights", (3, 0), -0.5), "expected weights from 0 that sum to 1, found -0.5"),
    "weights of 2": ({"weights": 2 * GOOD["weights"]}, "expected weights from 0 that sum to 1"),
    "weights of NaN": (changed("weights", (3, 0), np.nan), "expected finite numbers in weights"),
    "fewer weights": ({"weights": GOOD["weights"][:20]}, "expected weights of shape (30, 24), found (20, 24)"),
    "a loop": (changed("kintree_table", (0, 3), 7), "expected parents before their children in kintree_table"),
    "itself": (changed("kintree_table", (0, 3), 3), "expected parents before their children in kintree_table"),
    "two roots": (changed("kintree_table", (0, 3), 2**32 - 1), "expected parents before their children"),
    "no table": ({"kintree_table": np.zeros(24)}, "expected kintree_table of shape (2, joints), found (24,)"),
    "a face too far": (changed("f", (0, 0), 30), "expected faces of 30 vertices, found vertex 30"),
    "a face that wraps": (changed("f", (0, 0), 2**32), "expected faces of 30 vertices, found vertex 4294967296"),
    "a negative face": (changed("f", (0, 0), -1), "expected faces of 30 vertices, found vertex"),
    "half a face": ({"f": GOOD["f"] + 0.5}, "expected f as triangles, found float64"),
    "squares": ({"f": np.zeros((4, 4), int)}, "expected f as triangles, found int64 of shape (4, 4)"),
    "no vertices": ({"v_template": np.zeros((0, 3))}, "expected v_template of shape (any, 3), found (0, 3)"),
    "infinite vertices": (changed("v_template", (0, 0), np.inf), "expected finite numbers in v_template"),
    "shapes of others": ({"shapedirs": np.zeros((29, 3, 10))}, "expected shapedirs of shape (30, 3, any)"),
    "flat shapes": ({"shapedirs": np.zeros((90, 10))}, "expected shapedirs of shape (30, 3, any), found (90, 10)"),
    "poses of others": ({"posedirs": np.zeros((29, 3, 207))}, "expected posedirs of 30 vertices"),
    "poses of NaN": (changed("posedirs", (0, 0, 0), np.nan), "expected finite numbers in posedirs"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_body_is_one_line(name: str, tmp_path: Path) -> None:
    change, said = WRONG[name]
    write_npz(tmp_path / "body.npz", **{**smpl_fields(), **change})
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read_smpl(tmp_path / "body.npz")
    assert caught.value.where == str(tmp_path / "body.npz")


def test_pose_directions_in_every_layout_are_the_same(tmp_path: Path) -> None:
    fields = smpl_fields()
    expected = np.moveaxis(fields["posedirs"], 2, 0)
    flat = fields["posedirs"].reshape(90, 207)
    for posedirs in (fields["posedirs"], flat, flat.T, np.asfortranarray(fields["posedirs"])):
        write_npz(tmp_path / "body.npz", **{**fields, "posedirs": posedirs})
        found = read_smpl(tmp_path / "body.npz").pose_directions
        assert found is not None
        np.testing.assert_allclose(found, expected, atol=1e-7)


@pytest.mark.parametrize("protocol", range(6))
def test_a_pickle_of_every_protocol_is_the_same_body(protocol: int, tmp_path: Path) -> None:
    from scipy import sparse

    fields = smpl_fields(3)
    write_npz(tmp_path / "body.npz", **fields)
    sparse_too = {**fields, "J_regressor": sparse.csc_matrix(fields["J_regressor"]), "bs_type": "lrotmin"}
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(sparse_too, protocol=protocol))
    first, second = read_smpl(tmp_path / "body.npz"), read_smpl(tmp_path / "body.pkl")
    for name in ("joints", "skin_weights", "shape_directions", "pose_directions", "joint_directions"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
