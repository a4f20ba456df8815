"""Every stage as a function, by the name of its command: what `capture4d COMMAND` does, for Python.

Folders are named by paths; CAPTURE and WORK may also be handed over open, as `read_capture` and `open_work` return
them. Stages with `overwrite` resume what was stopped, refuse to go on with other settings unless told to, and return a
`StageResult`. The number of workers never changes a result; it is 1 unless given, and with more, a script has to call
from under `if __name__ == "__main__":`, for its processes import it.
"""

from capture4d.app.export.export import export, export_onnx, texture
from capture4d.app.importing.folders import import_meshes, score
from capture4d.app.status.work_folders import diff, status
from capture4d.app.status.work_folders import plan as plan
from capture4d.steps.models import (
    animate,
    compare,
    fit,
    fit_style,
    fit_styles,
    wrinkles_apply,
    wrinkles_maps,
    wrinkles_train,
)
from capture4d.steps.offsets import (
    offsets_apply,
    offsets_draw,
    offsets_edit,
    offsets_predict,
    offsets_train,
    wrinkles_offsets,
)
from capture4d.steps.synthesis import scan, synth, synth_board, synth_drapes
from capture4d.steps.takes import (
    calibrate,
    check,
    check_rig,
    extract,
    register,
    register_mesh,
    report,
    run,
    template,
    track,
)
from capture4d.steps.takes import renew as renew
from capture4d.steps.takes import take_over as take_over

__all__ = [
    "animate", "calibrate", "check", "check_rig", "compare", "diff", "export", "export_onnx", "extract", "fit",
    "fit_style", "fit_styles", "import_meshes", "offsets_apply", "offsets_draw", "offsets_edit", "offsets_predict",
    "offsets_train", "register", "register_mesh", "report", "run", "scan", "score", "status", "synth", "synth_board",
    "synth_drapes", "template", "texture", "track", "wrinkles_apply", "wrinkles_maps", "wrinkles_offsets",
    "wrinkles_train",
]  # fmt: skip
