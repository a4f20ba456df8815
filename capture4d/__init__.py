"""From 4D scans of a clothed person to a garment that can be animated.

The values that pass between stages, how they are read and written, and functions on arrays. The stages themselves are
functions on folders in `capture4d.pipeline`, by the names of their commands. A name is loaded when it is first used;
every module that is not named here is internal, and may move.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from capture4d.own_packages import claim_names

if TYPE_CHECKING:
    from capture4d import configs as configs
    from capture4d import pipeline as pipeline
    from capture4d.body.anny import load_anny as load_anny
    from capture4d.body.skinning import pose_frame as pose_frame
    from capture4d.body.skinning import skin as skin
    from capture4d.body.skinning import unskin as unskin
    from capture4d.body.skinning import with_pose as with_pose
    from capture4d.body.skinning import with_shape as with_shape
    from capture4d.captures.capture import Capture as Capture
    from capture4d.captures.capture import read_capture as read_capture
    from capture4d.captures.capture import read_scan as read_scan
    from capture4d.captures.capture import write_capture_description as write_capture_description
    from capture4d.captures.capture import write_scan as write_scan
    from capture4d.captures.work_folder import WorkFolder as WorkFolder
    from capture4d.captures.work_folder import open_work as open_work
    from capture4d.errors import InputError as InputError
    from capture4d.errors import StaleError as StaleError
    from capture4d.files.records import load_body as load_body
    from capture4d.files.records import load_garment as load_garment
    from capture4d.files.records import load_poses as load_poses
    from capture4d.files.records import load_rig as load_rig
    from capture4d.files.records import save_body as save_body
    from capture4d.files.records import save_garment as save_garment
    from capture4d.files.records import save_poses as save_poses
    from capture4d.files.records import save_rig as save_rig
    from capture4d.mesh_files.meshes import read_coloured_mesh as read_coloured_mesh
    from capture4d.mesh_files.meshes import read_mesh as read_mesh
    from capture4d.mesh_files.meshes import write_mesh as write_mesh
    from capture4d.motions.clips import MotionWords as MotionWords
    from capture4d.motions.motion_files import read_motion as read_motion
    from capture4d.motions.motion_files import write_motion as write_motion
    from capture4d.one_shot import load_garment_model as load_garment_model
    from capture4d.one_shot import load_registered as load_registered
    from capture4d.one_shot import load_styled_garment as load_styled_garment
    from capture4d.one_shot import register_mesh as register_mesh
    from capture4d.one_shot import wrinkle_map as wrinkle_map
    from capture4d.runs.cluster.scheduler import use_scheduler as use_scheduler
    from capture4d.runs.stage import StageResult as StageResult
    from capture4d.types import BlendshapeModel as BlendshapeModel
    from capture4d.types import Body as Body
    from capture4d.types import Garment as Garment
    from capture4d.types import GarmentScan as GarmentScan
    from capture4d.types import Mesh as Mesh
    from capture4d.types import PoseSequence as PoseSequence
    from capture4d.types import RegisteredSequence as RegisteredSequence
    from capture4d.types import Rig as Rig
    from capture4d.types import Scan as Scan

claim_names()

_HOMES = {
    "capture4d.body.anny": "load_anny",
    "capture4d.motions.clips": "MotionWords",
    "capture4d.motions.motion_files": "read_motion write_motion",
    "capture4d.body.skinning": "pose_frame skin unskin with_pose with_shape",
    "capture4d.captures.capture": "Capture read_capture read_scan write_capture_description write_scan",
    "capture4d.captures.work_folder": "WorkFolder open_work",
    "capture4d.errors": "InputError StaleError",
    "capture4d.mesh_files.meshes": "read_coloured_mesh read_mesh write_mesh",
    "capture4d.files.records": "load_body load_garment load_poses load_rig save_body save_garment save_poses save_rig",
    "capture4d.one_shot": "load_garment_model load_registered load_styled_garment register_mesh wrinkle_map",
    "capture4d.runs.cluster.scheduler": "use_scheduler",
    "capture4d.runs.stage": "StageResult",
    "capture4d.types": "BlendshapeModel Body Garment GarmentScan Mesh PoseSequence RegisteredSequence Rig Scan",
}
_HOME = {name: module for module, names in _HOMES.items() for name in names.split()}
__all__ = ["__version__", "configs", "pipeline", *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        value = version("capture4d")
    elif name in ("configs", "pipeline"):
        value = import_module(f"capture4d.{name}")
    elif name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module 'capture4d' has no attribute '{name}'")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
