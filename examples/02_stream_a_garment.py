"""Drive a learned garment frame by frame, as a game or a live preview would, and write one mesh a frame.

    capture4d fit WORK --output SHIRT
    python examples/02_stream_a_garment.py SHIRT poses.npz MESHES

The poses are at the model's frame rate. Nothing here looks ahead: the numbers are those of `capture4d animate --mean
captured --removal.no-enabled`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from capture4d.body.skinning import skin, with_pose
from capture4d.files.records import load_poses
from capture4d.mesh_files.meshes import write_mesh
from retarget.animation.garment_model import load_garment_model
from retarget.regression.controls import ControlStream
from retarget.shapes.blendshapes import reconstruct


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("poses", type=Path)
    parser.add_argument("meshes", type=Path)
    options = parser.parse_args()

    known = load_garment_model(options.model)
    model, person = known.model, known.person()
    assert model.garment.skin_weights is not None, "a learned garment is bound to a body"
    regressor = known.best
    controls, answers = ControlStream(regressor.layout), regressor.stream()
    poses = load_poses(options.poses)
    regressor.layout.require(poses)
    for rotations, translation, frame_id in zip(poses.rotations, poses.translations, poses.frame_ids, strict=True):
        coefficients = answers.push(controls.push(rotations, translation, float(frame_id) / poses.fps))
        rest = reconstruct(model.mean, model.basis, coefficients[None])[0]
        vertices = skin(rest, model.garment.skin_weights, with_pose(person, rotations, translation).transforms)
        mesh = model.garment.template.with_vertices(vertices.astype("float32"))
        write_mesh(options.meshes / f"{int(frame_id):06d}.ply", mesh)
    print(f"{len(poses.frame_ids)} meshes: {options.meshes}")


if __name__ == "__main__":
    main()
