"""What Blender shows after open_in_blender.py: vertices, rate, range, and maps that follow the timeline.

    python check_opened.py open_in_blender.py VERTICES.npy FPS FIRST_FRAME TOLERANCE_MM FILE     # with the bpy wheel

FILE: a name beside the script. TOLERANCE_MM: of a GLB, the error that the export has told. Exit code 1 on a mismatch.
"""

import os
import runpy
import sys

import bpy
import numpy as np

script, vertices, fps, first, tolerance, name = sys.argv[1:7]
fps, first, tolerance, want = float(fps), int(first), float(tolerance), np.load(vertices)
faults = []
sys.argv = [script, "--", name]
runpy.run_path(script, run_name="__main__")

scene = bpy.context.scene
start = 0 if name.endswith(".glb") else first
if abs(scene.render.fps / scene.render.fps_base - fps) > 1e-3:
    faults.append(f"rate {scene.render.fps / scene.render.fps_base:g}")
if (scene.frame_start, scene.frame_end) != (start, start + len(want) - 1):
    faults.append(f"range {scene.frame_start} to {scene.frame_end}")
obj = max((o for o in bpy.data.objects if o.type == "MESH"), key=lambda o: len(o.data.vertices))
number = np.arange(len(obj.data.vertices))
if "_VERTEX" in obj.data.attributes:
    values = np.empty(len(number), np.float32)
    obj.data.attributes["_VERTEX"].data.foreach_get("value", values)
    number = np.rint(values).astype(int)
worst = 0.0
for row in range(0, len(want), 5):
    scene.frame_set(start + row)
    each = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = each.to_mesh()
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    matrix = np.array(each.matrix_world)
    world = flat.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    each.to_mesh_clear()
    shown = np.stack([world[:, 0], world[:, 2], -world[:, 1]], axis=1)
    worst = max(worst, 1000 * float(np.linalg.norm(shown - want[row][number], axis=1).max()))
if not worst <= tolerance:
    faults.append(f"vertices {worst:.4f} mm off")

normals = os.path.join(os.path.dirname(script), "normals")
if os.path.isdir(normals):
    nodes = [n for m in bpy.data.materials if m.node_tree for n in m.node_tree.nodes if n.type == "TEX_IMAGE"]
    if len(nodes) != 1 or nodes[0].image.source != "SEQUENCE":
        faults.append("no image sequence")
    else:
        user = nodes[0].image_user
        shown = start - user.frame_start + 1 + user.frame_offset
        if (shown, user.frame_duration, user.use_auto_refresh) != (first, len(want), True):
            faults.append(f"the first picture is {shown} of {user.frame_duration}")
for fault in faults:
    print(f"MISMATCH               {name}: {fault}")
sys.stdout.flush()
os._exit(1 if faults else 0)
