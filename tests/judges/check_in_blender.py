"""Acceptance check with Blender as the judge: is the garment in a file the one that was registered?

    blender -b --factory-startup --python-exit-code 1 -P check_in_blender.py -- FILE VERTICES.npy [options]
    python check_in_blender.py FILE VERTICES.npy [options]          # in an environment with the `bpy` wheel

FILE: .glb .gltf .usd .usda .usdc .usdz .abc, or .pc2 .mdd with --base garment.obj.
VERTICES: (T, V, 3) float32, metres, Y up. Reads the *evaluated* mesh in every frame (modifiers, shape keys, skeleton,
caches), takes it from Blender's world (Z up) back to Y up, and compares.
Prints one line per finding and, at last, one of JSON.
Exit code 0: everything that was asked for is there; 1: a mismatch; 2: Blender cannot read this format.
"""

import argparse
import json
import math
import os
import sys
import time

import bpy
import numpy as np

if not hasattr(np, "bool"):
    np.bool = bool  # Debian's Blender 3.4.1 reads GLB with a name that its numpy 1.24 no longer has

p = argparse.ArgumentParser()
p.add_argument("file")
p.add_argument("vertices")
p.add_argument("--template", help="garment.npz: template_faces and template_uv to compare")
p.add_argument("--base", help="mesh for a point cache")
p.add_argument(
    "--fps", type=float, help="expected; the scene is set to it before a GLB or a cache is imported, as a user must"
)
p.add_argument("--keep-scene-fps", action="store_true", help="import as a new user does, at Blender's 24 fps")
p.add_argument("--first-frame", type=int, default=1, help="scene frame of VERTICES[0]")
p.add_argument("--tolerance-mm", type=float, default=0.01)
p.add_argument("--normal-map", choices=("none", "static", "sequence"), default="none", help="what must be connected")
p.add_argument("--normal-file", help="picture of frame VERTICES[0]: its pixels are compared")
p.add_argument("--every", type=int, default=1, help="check every n-th frame")
p.add_argument(
    "--normals-p99-deg",
    type=float,
    help="largest angle, 99th percentile, between shading normals and those of VERTICES (needs --template)",
)
p.add_argument(
    "--smooth", action="store_true", help="GLB: import with Shading = Smooth Shading instead of the file's normals"
)
p.add_argument("--render")
p.add_argument("--render-frame", type=int)
p.add_argument("--samples", type=int, default=16)
p.add_argument("--size", type=int, default=480)
a = p.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])

found, faults = (
    {
        "blender": bpy.app.version_string,
        "file": os.path.basename(a.file),
        "mb": round(os.path.getsize(a.file) / 1e6, 3),
    },
    [],
)


def say(key, value):
    found[key] = value
    print(f"{key:22s} {value}", flush=True)


def fault(text):
    faults.append(text)
    print(f"MISMATCH               {text}", flush=True)


want = np.load(a.vertices, mmap_mode="r")
frames = [a.first_frame + t for t in range(len(want))]
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene


def set_rate(rate):
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate


def rate():
    return scene.render.fps / scene.render.fps_base


suffix = os.path.splitext(a.file)[1].lower()
path = os.path.abspath(a.file)
if a.fps and not a.keep_scene_fps:
    set_rate(a.fps)
start = time.perf_counter()
try:
    if suffix in (".glb", ".gltf"):
        bpy.ops.import_scene.gltf(
            filepath=path, merge_vertices=False, import_shading="SMOOTH" if a.smooth else "NORMALS"
        )
    elif suffix in (".usd", ".usda", ".usdc", ".usdz"):
        bpy.ops.wm.usd_import(filepath=path)
    elif suffix == ".abc":
        bpy.ops.wm.alembic_import(filepath=path, as_background_job=False, validate_meshes=False)
    elif suffix in (".pc2", ".mdd"):
        bpy.ops.wm.obj_import(filepath=os.path.abspath(a.base))
        target = next(o for o in scene.objects if o.type == "MESH")
        m = target.modifiers.new("cache", "MESH_CACHE")
        m.cache_format, m.filepath, m.frame_start = suffix[1:].upper(), path, a.first_frame
    else:
        raise SystemExit(f"unknown format {suffix}")
except (AttributeError, RuntimeError) as error:
    if "could not be found" in str(error) or isinstance(error, AttributeError):
        print(f"this Blender ({bpy.app.version_string}) cannot read {suffix}: {error}")
        os._exit(2)
    raise
say("import_s", round(time.perf_counter() - start, 3))
meshes = sorted((o for o in bpy.data.objects if o.type == "MESH"), key=lambda o: -len(o.data.vertices))
if not meshes:
    fault("no mesh in the file")
    print(json.dumps(found | {"faults": faults}))
    os._exit(1)
obj = meshes[0]
say(
    "mesh",
    f"{obj.name}: {len(obj.data.vertices)} vertices, {len(obj.data.polygons)} faces; {len(meshes)} mesh object(s)",
)
say("modifiers", [f"{m.type}" for m in obj.modifiers])
say("shape_keys", len(obj.data.shape_keys.key_blocks) if obj.data.shape_keys else 0)
say("scene_fps", round(rate(), 4))
say("scene_range", [scene.frame_start, scene.frame_end])
actions = [tuple(round(float(x), 3) for x in action.frame_range) for action in bpy.data.actions]
say("action_ranges", sorted(set(actions)))
if a.fps and abs(rate() - a.fps) > 1e-3:
    fault(f"frame rate {rate():g}, expected {a.fps:g}")
say("size_m", [round(float(x), 3) for x in obj.dimensions])


def evaluated(frame):
    whole = math.floor(frame)
    scene.frame_set(whole, subframe=frame - whole)
    each = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = each.to_mesh()
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    m = np.array(each.matrix_world, np.float64)
    w = flat.reshape(-1, 3).astype(np.float64) @ m[:3, :3].T + m[:3, 3]
    each.to_mesh_clear()
    return np.stack([w[:, 0], w[:, 2], -w[:, 1]], axis=1)  # Blender's Z up to Y up


first = evaluated(a.first_frame)
count = want.shape[1]
attribute = obj.data.attributes.get("_VERTEX") if hasattr(obj.data, "attributes") else None
if len(first) == count and attribute is None:
    vertex, how = np.arange(count), "same order"
elif attribute is not None and len(attribute.data) == len(first):
    value = np.empty(len(first), np.float32)
    attribute.data.foreach_get("value", value)
    vertex, how = np.rint(value).astype(int), "attribute _VERTEX"
else:
    best = None  # nearest in the frame of the file that fits best (frame numbers may be off)
    small = np.asarray(want[0], np.float64)
    for shift in (0, -1, 1):
        points = evaluated(a.first_frame + shift)
        nearest = np.concatenate(
            [
                ((part[:, None] - small[None]) ** 2).sum(-1).argmin(1)
                for part in np.array_split(points, max(1, len(points) // 200))
            ]
        )
        far = np.linalg.norm(points - small[nearest], axis=1).max()
        if best is None or far < best[0]:
            best = (far, nearest)
    vertex, how = best[1], f"nearest vertex ({1000 * best[0]:.3f} mm)"
say("vertex_map", how)
if len(set(vertex.tolist())) != count:
    fault(f"{len(set(vertex.tolist()))} of {count} template vertices found")
# which scene frame shows VERTICES[0] (or, if frame 0 is at rest for long, the best over a few frames)?
probe = min(len(want) - 1, 7)
shifts = {
    s: float(np.abs(evaluated(frames[probe] + s) - want[probe][vertex]).max())
    for s in (0, -1, 1, -a.first_frame, 1 - a.first_frame)
}
shift = min(shifts, key=shifts.get)
say("frame_offset", shift)
if shift:
    fault(f"VERTICES[0] is shown at frame {a.first_frame + shift}, expected {a.first_frame}")
start = time.perf_counter()
errors = [
    np.linalg.norm(evaluated(frames[t] + shift) - np.asarray(want[t], np.float64)[vertex], axis=1) * 1000
    for t in range(0, len(want), a.every)
]
say("read_ms_per_frame", round((time.perf_counter() - start) / len(errors) * 1000, 2))
errors = np.array(errors)
say("frames_checked", len(errors))
say("mean_error_mm", round(float(errors.mean()), 6))
say("p99_error_mm", round(float(np.percentile(errors, 99)), 6))
say("max_error_mm", round(float(errors.max()), 6))
say("worst_frame", int(errors.max(1).argmax()) * a.every + a.first_frame)
if not errors.max() <= a.tolerance_mm:
    fault(f"max error {errors.max():.4f} mm, allowed {a.tolerance_mm:g} mm")
moved = float(np.linalg.norm(want[len(want) // 2] - want[0], axis=1).max() * 1000)
say("moves_mm", round(moved, 1))
# a frame between two: does the file interpolate, or hold?
between = evaluated(frames[probe] + shift + 0.5)
middle = 0.5 * (np.asarray(want[probe], np.float64) + want[min(probe + 1, len(want) - 1)])[vertex]
say("between_frames_mm", round(float(np.linalg.norm(between - middle, axis=1).max() * 1000), 4))

layers = [layer.name for layer in obj.data.uv_layers]
say("uv_layers", layers)
if a.template:
    arrays = np.load(a.template)
    faces, uv = arrays["template_faces"], arrays["template_uv"]
    if not layers:
        fault("no UV layer")
    else:
        loops = np.empty(len(obj.data.loops), np.int32)
        obj.data.loops.foreach_get("vertex_index", loops)
        got = np.empty(2 * len(loops), np.float32)
        obj.data.uv_layers[0].data.foreach_get("uv", got)
        got = got.reshape(-1, 3, 2)
        triangles = vertex[loops].reshape(-1, 3)
        if len(triangles) != len(faces):
            fault(f"{len(triangles)} faces, expected {len(faces)}")
        key = {tuple(sorted(f)): i for i, f in enumerate(faces.tolist())}
        worst, turned, missing = 0.0, 0, 0
        for corner, coordinates in zip(triangles.tolist(), got, strict=False):
            i = key.get(tuple(sorted(corner)))
            if i is None:
                missing += 1
                continue
            at = [faces[i].tolist().index(c) for c in corner]
            worst = max(worst, float(np.abs(coordinates - uv[i][at]).max()))
            turned += (at[1] - at[0]) % 3 != 1
        say("uv_max_difference", round(worst, 8))
        say("faces_turned", turned)
        say("faces_missing", missing)
        if worst > 1e-4:
            fault(f"UVs differ by {worst:g}")
        if turned:
            fault(f"{turned} faces seen from inside")
        if missing:
            fault(f"{missing} faces of no template face")

    # what shading sees: normals of the evaluated corners against the area-weighted vertex normals of the truth
    angles = []
    for t in sorted({0, len(want) // 4, len(want) // 2, len(want) - 1}):
        evaluated(frames[t] + shift)
        each = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = each.to_mesh()
        got = np.empty(3 * len(mesh.loops), np.float32)
        if hasattr(mesh, "corner_normals"):
            mesh.corner_normals.foreach_get("vector", got)
        else:
            mesh.calc_normals_split()
            mesh.loops.foreach_get("normal", got)
        turn = np.array(each.matrix_world, np.float64)[:3, :3]
        got = got.reshape(-1, 3) @ np.linalg.inv(turn)
        got = np.stack([got[:, 0], got[:, 2], -got[:, 1]], axis=1)
        each.to_mesh_clear()
        points = np.asarray(want[t], np.float64)
        flat = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
        true = np.stack(
            [sum(np.bincount(faces[:, k], flat[:, axis], count) for k in range(3)) for axis in range(3)], axis=1
        )
        true /= np.linalg.norm(true, axis=1, keepdims=True)
        got /= np.maximum(np.linalg.norm(got, axis=1, keepdims=True), 1e-20)
        angles.append(np.degrees(np.arccos(np.clip((got * true[vertex[loops]]).sum(1), -1, 1))))
    angles = np.array(angles)
    say(
        "normals_deg",
        {
            "mean": round(float(angles.mean()), 3),
            "p99": round(float(np.percentile(angles, 99)), 2),
            "max": round(float(angles.max()), 1),
        },
    )
    if a.normals_p99_deg is not None and not np.percentile(angles, 99) <= a.normals_p99_deg:
        fault(f"shading normals turned by {np.percentile(angles, 99):.1f} degrees (p99)")

maps = []
for slot in obj.material_slots:
    if not slot.material or not slot.material.use_nodes:
        continue
    for node in slot.material.node_tree.nodes:
        if node.type == "NORMAL_MAP" and node.outputs[0].is_linked:
            surface = node.outputs[0].links[0].to_node.type
            if node.inputs["Color"].is_linked:
                source = node.inputs["Color"].links[0].from_node
                seen, queue = None, [source]
                while queue:
                    each = queue.pop()
                    if each.type == "TEX_IMAGE":
                        seen = each
                        break
                    queue += [link.from_node for s in each.inputs for link in s.links]
                if seen is None or seen.image is None:
                    continue
                image = seen.image
                maps.append(
                    {
                        "into": surface,
                        "image": image.name,
                        "source": image.source,
                        "frames": seen.image_user.frame_duration if image.source == "SEQUENCE" else 1,
                        "auto_refresh": seen.image_user.use_auto_refresh,
                        "size": list(image.size),
                        "colours": image.colorspace_settings.name,
                        "uv": node.uv_map or "(active)",
                        "strength": node.inputs["Strength"].default_value,
                        "via": source.type,
                    }
                )
                if a.normal_file and next(iter(image.size)):
                    truth = bpy.data.images.load(os.path.abspath(a.normal_file))
                    truth.colorspace_settings.name = "Non-Color"
                    if list(truth.size) == list(image.size):
                        x, y = np.empty(len(truth.pixels), np.float32), np.empty(len(image.pixels), np.float32)
                        truth.pixels.foreach_get(x)
                        image.pixels.foreach_get(y)
                        maps[-1]["pixel_difference"] = round(float(np.abs(x - y).max() * 255), 3)
say("normal_maps", maps)
if a.normal_map != "none":
    if not maps:
        fault("no normal map is connected")
    else:
        one = maps[0]
        if one["colours"] not in ("Non-Color", "Raw", "Generic Data"):
            fault(f"normal map is read as {one['colours']}")
        if not one["size"][0]:
            fault("normal map's picture is missing")
        if one.get("pixel_difference", 0) > 1.01:
            fault(f"normal map's pixels differ by {one['pixel_difference']} of 255")
        if a.normal_map == "sequence" and one["source"] != "SEQUENCE":
            fault(f"normal map does not change with the frames ({one['source']})")

if a.render:
    from mathutils import Vector

    frame = a.render_frame if a.render_frame is not None else frames[len(frames) // 2]
    evaluated(frame)
    box = evaluated(frame)
    low, high = box.min(0), box.max(0)
    centre = Vector((*((low + high) / 2)[[0]], -((low + high) / 2)[2], ((low + high) / 2)[1]))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.data.lens = 70
    camera.location = centre + Vector((0.9, -2.2, 0.35))
    camera.rotation_euler = (centre - camera.location).to_track_quat("-Z", "Y").to_euler()
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    scene.collection.objects.link(sun)
    sun.data.energy = 3.0
    sun.rotation_euler = Vector((1.0, 0.7, -0.55)).to_track_quat("-Z", "Y").to_euler()
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (0.35, 0.37, 0.4, 1)
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = a.samples
    scene.cycles.use_denoising = False
    scene.render.threads_mode = "FIXED"
    scene.render.threads = 1
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x = scene.render.resolution_y = a.size
    scene.render.filepath = os.path.abspath(a.render)
    start = time.perf_counter()
    bpy.ops.render.render(write_still=True)
    say("render_s", round(time.perf_counter() - start, 1))
found["faults"] = faults
print(json.dumps(found, default=str))
print("OK" if not faults else f"{len(faults)} mismatch(es)")
sys.stdout.flush()
os._exit(1 if faults else 0)
