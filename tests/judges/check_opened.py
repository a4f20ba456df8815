"""What Blender shows after open_in_blender.py: vertices, rate, range, pictures and scans that follow the timeline.

    python check_opened.py open_in_blender.py VERTICES.npy FPS FILE     # with the bpy wheel
    python check_opened.py open_in_blender.py VERTICES.npy FPS FILE --as-blender

FILE: a name beside the script. --as-blender: the script is told what `blender -P open_in_blender.py` tells it, and FILE
is what it should find by itself. A file body.npy beside VERTICES.npy has the body's vertices. Scans, if there are any,
have the garment's vertices, and as red of all of them the row of their frame. Exit code 1 on a mismatch.
"""

import json
import os
import runpy
import sys

import bpy
import numpy as np

script, vertices, fps, name = sys.argv[1:5]
fps, want = float(fps), np.load(vertices)
here, faults = os.path.dirname(script), []
with open(os.path.join(here, "export.json"), encoding="utf-8") as file:
    told = json.load(file)
ids = told["frames"]


class Blender:
    """bpy.app as it is in Blender itself."""

    module = False

    def __getattr__(self, attribute, real=bpy.app):
        return getattr(real, attribute)


if "--as-blender" in sys.argv:
    sys.argv, bpy.app = ["blender", "-P", script], Blender()
else:
    sys.argv = [script, "--", name]
runpy.run_path(script, run_name="__main__")

scene, collections = bpy.context.scene, bpy.data.collections
frames = [each - ids[0] if name.endswith(".glb") else each for each in ids]
if abs(scene.render.fps / scene.render.fps_base - fps) > 1e-3:
    faults.append(f"rate {scene.render.fps / scene.render.fps_base:g}")
if (scene.frame_start, scene.frame_end) != (frames[0], frames[-1]):
    faults.append(f"range {scene.frame_start} to {scene.frame_end}")


def largest(collection):
    meshes = (each for each in collections[collection].objects if each.type == "MESH")
    return max(meshes, key=lambda each: len(each.data.vertices))


def shown(obj):
    """Places in the frame that the scene is at, metres, Y up."""
    each = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = each.to_mesh()
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    matrix = np.array(each.matrix_world)
    world = flat.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    each.to_mesh_clear()
    return np.stack([world[:, 0], world[:, 2], -world[:, 1]], axis=1)


def require_close(what, wanted):
    """Within what the export has told of a file."""
    obj, key = largest(what), name.rpartition(".")[2].replace("usdc", "usd")
    limit = 0.002 + told["files"][key if what == "garment" else f"{what} {key}"]["error_mm"]
    number = np.arange(len(obj.data.vertices))
    if "_VERTEX" in obj.data.attributes:
        values = np.empty(len(number), np.float32)
        obj.data.attributes["_VERTEX"].data.foreach_get("value", values)
        number = np.rint(values).astype(int)
    worst = 0.0
    for row in range(0, len(wanted), 5):
        scene.frame_set(frames[row])
        worst = max(worst, 1000 * float(np.linalg.norm(shown(obj) - wanted[row][number], axis=1).max()))
    if not worst <= limit:
        faults.append(f"{what} {worst:.4f} mm off, {limit:.4f} allowed")


require_close("garment", want)
body = os.path.join(os.path.dirname(vertices), "body.npy")
if os.path.exists(body):
    require_close("body", np.load(body))

pictures = [n for n in largest("garment").active_material.node_tree.nodes if n.type == "TEX_IMAGE"]
into = {node.outputs[0].links[0].to_socket.name: node for node in pictures if node.outputs[0].is_linked}
if os.path.exists(os.path.join(here, "albedo.png")):
    colours = into.pop("Base Color", None)
    if colours is None or not colours.image.size[0]:
        faults.append("no colours on the garment")
if os.path.isdir(os.path.join(here, "normals")):
    bump = into.pop("Color", None)
    if bump is None or bump.image.source != "SEQUENCE" or not bump.image_user.use_auto_refresh:
        faults.append("no image sequence")
    else:
        for frame in range(frames[0], frames[-1] + 1):
            number = max(each for each, row in zip(ids, frames, strict=True) if row <= frame)
            scene.frame_set(frame)
            garment = largest("garment").evaluated_get(bpy.context.evaluated_depsgraph_get())
            user = garment.active_material.node_tree.nodes[bump.name].image_user
            at = min(frame - user.frame_start + 1, user.frame_duration) + user.frame_offset
            if at != number:
                faults.append(f"at frame {frame} the picture is {at}, not {number}")
                break
if into:
    faults.append(f"pictures that lead nowhere known: {sorted(into)}")

if os.path.isdir(os.path.join(here, "scans")):
    chosen = sorted(int(each.name) for each in collections["scans"].objects)
    for row, frame in enumerate(frames):
        scene.frame_set(frame)
        seen = [each for each in collections["scans"].objects if not each.hide_render and not each.hide_viewport]
        at = ids.index(max((each for each in chosen if each <= ids[row]), default=chosen[0]))
        if len(seen) != 1:
            faults.append(f"{len(seen)} scans at frame {frame}")
            break
        away = 1000 * np.linalg.norm(shown(seen[0]) - want[at], axis=1).max()
        red = {round(255 * each.color_srgb[0]) for each in seen[0].data.color_attributes[0].data}
        if away > 0.001 or red != {at}:
            faults.append(f"at frame {frame} a scan {away:.3f} mm off, its red {red}, not {at}")
            break
    if "VERTEX_COLOR" not in {node.type for node in seen[0].active_material.node_tree.nodes}:
        faults.append("the scans' material shows no colours")
for fault in faults:
    print(f"MISMATCH               {name}: {fault}")
sys.stdout.flush()
os._exit(1 if faults else 0)
