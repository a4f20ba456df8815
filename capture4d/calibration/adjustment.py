"""Bundle adjustment of a rig that looks at one board.

COLMAP's world is the board: its corners are constant points, every pose of the board is a frame of one rig, and the
scale comes from the squares. Solved by Ceres through pycolmap, with Cauchy's loss, because a detector's errors have
heavy tails: most corners are good to a few hundredths of a pixel, some are wrong by several pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from capture4d.cameras.board import BoardView
from capture4d.cameras.colmap import colmap_camera, lens_of, sensor, to_colmap_pixels
from capture4d.cameras.projection import camera_lens, project, transform
from capture4d.errors import InputError
from capture4d.heavy_imports import import_pycolmap
from capture4d.types import Rig

__all__ = ["RigEstimate", "adjust_rig", "view_residuals"]


@dataclass(frozen=True, slots=True, eq=False)
class RigEstimate:
    """A rig, and where the board was."""

    rig: Rig
    T_world_board: Float64[np.ndarray, "poses 4 4"]
    corners: Float64[np.ndarray, "corners 3"]
    """Of the board, in its own axes, metres."""


def adjust_rig(
    start: RigEstimate,
    views: Sequence[BoardView],
    *,
    loss_px: float,
    iterations: int = 50,
    free_board: bool = False,
) -> RigEstimate:
    """Refine lenses, cameras and board poses together.

    Args:
        start: good to a few pixels. Its first camera that sees the board stays where it is.
        loss_px: scale of Cauchy's loss; a residual far above it has next to no weight.
        free_board: solve for the shape of the board as well, all but three of its corners.
    Raises:
        InputError: Ceres found no usable solution.
    """
    pycolmap = import_pycolmap()
    reference = views[0].camera
    model = _reconstruction(start, views, reference)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.max_num_iterations = iterations
    options.ceres.solver_options.num_threads = 1  # the same sums in the same order
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    fixed = _far_apart(start.corners[sorted(point_id - 1 for point_id in model.point3D_ids())])
    fixed_ids = {sorted(model.point3D_ids())[row] for row in fixed}
    for point_id in model.point3D_ids():
        if free_board and point_id not in fixed_ids:
            config.add_variable_point(point_id)
        else:
            config.add_constant_point(point_id)
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    if not summary.is_solution_usable():
        raise InputError(
            "board images: expected corners that agree on one rig and one board, found no solution of the bundle "
            "adjustment; look for mixed-up cameras or poses, and for images of another board"
        )
    return _estimate(start, model, views, reference)


def view_residuals(estimate: RigEstimate, view: BoardView) -> Float64[np.ndarray, "found 2"]:
    """Predicted less detected corners, pixels."""
    rig = estimate.rig
    T_camera_board = rig.T_camera_world[view.camera] @ estimate.T_world_board[view.pose]
    local = transform(T_camera_board, estimate.corners[view.ids])
    return project(local, camera_lens(rig, view.camera)) - view.pixels


def _reconstruction(start: RigEstimate, views: Sequence[BoardView], reference: int) -> Any:
    """The pycolmap.Reconstruction: ids are our indices plus one."""
    pycolmap = import_pycolmap()
    rig = start.rig
    T_world_reference = np.linalg.inv(rig.T_camera_world[reference])
    model = pycolmap.Reconstruction()
    colmap_rig = pycolmap.Rig(rig_id=1)
    colmap_rig.add_ref_sensor(sensor(reference + 1))
    for camera in sorted({view.camera for view in views}):
        model.add_camera(colmap_camera(camera + 1, camera_lens(rig, camera), rig.image_sizes[camera]))
        if camera != reference:
            T_camera_reference = rig.T_camera_world[camera] @ T_world_reference
            colmap_rig.add_sensor(sensor(camera + 1), pycolmap.Rigid3d(T_camera_reference[:3]))
    model.add_rig(colmap_rig)
    frames = {}
    for image_id, view in enumerate(views, start=1):
        frame = frames.setdefault(view.pose, pycolmap.Frame(frame_id=view.pose + 1, rig_id=1))
        frame.add_data_id(pycolmap.data_t(sensor(view.camera + 1), image_id))
    for pose, frame in frames.items():
        T_reference_board = rig.T_camera_world[reference] @ start.T_world_board[pose]
        frame.rig_from_world = pycolmap.Rigid3d(T_reference_board[:3])
        model.add_frame(frame)
    tracks: dict[int, Any] = {}
    for image_id, view in enumerate(views, start=1):
        image = pycolmap.Image(
            name=f"{view.camera:03d}/{view.pose:06d}.png",
            keypoints=to_colmap_pixels(view.pixels),
            camera_id=view.camera + 1,
            image_id=image_id,
        )
        image.frame_id = view.pose + 1
        model.add_image(image)
        for row, corner in enumerate(view.ids.tolist()):
            tracks.setdefault(corner, pycolmap.Track()).add_element(image_id, row)
    for pose in frames:
        model.register_frame(pose + 1)
    for corner, track in sorted(tracks.items()):
        model.add_point3D_with_id(corner + 1, pycolmap.Point3D(xyz=start.corners[corner], track=track))
    return model


def _estimate(start: RigEstimate, model: Any, views: Sequence[BoardView], reference: int) -> RigEstimate:
    rig = start.rig
    intrinsics, distortion = rig.intrinsics.copy(), rig.distortion.copy()
    T_camera_world, T_world_board = rig.T_camera_world.copy(), start.T_world_board.copy()
    colmap_rig = model.rigs[1]
    for camera in {view.camera for view in views}:
        lens = lens_of(model.cameras[camera + 1])
        intrinsics[camera], distortion[camera] = lens.intrinsics, lens.distortion
        if camera != reference:
            T_camera_reference = colmap_rig.sensor_from_rig(sensor(camera + 1)).matrix()
            T_camera_world[camera, :3] = T_camera_reference @ rig.T_camera_world[reference]
    T_world_reference = np.linalg.inv(rig.T_camera_world[reference])
    for pose in {view.pose for view in views}:
        T_world_board[pose, :3] = T_world_reference[:3, :3] @ model.frames[pose + 1].rig_from_world.matrix()
        T_world_board[pose, :3, 3] += T_world_reference[:3, 3]
    corners = start.corners.copy()
    for point_id in model.point3D_ids():
        corners[point_id - 1] = model.points3D[point_id].xyz
    adjusted = replace(rig, intrinsics=intrinsics, distortion=distortion, T_camera_world=T_camera_world)
    return RigEstimate(adjusted, T_world_board, corners)


def _far_apart(points: Float64[np.ndarray, "points 3"]) -> list[int]:
    """Three points that span the largest triangle, nearly."""
    first = int(np.argmin(points.sum(axis=1)))
    second = int(np.argmax(np.linalg.norm(points - points[first], axis=1)))
    edge = points[second] - points[first]
    third = int(np.argmax(np.linalg.norm(np.cross(points - points[first], edge), axis=1)))
    return [first, second, third]
