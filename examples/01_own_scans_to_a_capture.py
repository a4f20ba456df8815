"""Turn a folder of coloured scans and a template mesh into a capture folder, then register it.

    python examples/01_own_scans_to_a_capture.py SCANS TEMPLATE.obj CAPTURE --garment 2f62c9 --paint ffc400
    capture4d run CAPTURE --output WORK

SCANS holds one mesh with vertex colours per frame (ply, obj or glb, metres, Y up), named by frame number or in the
order of their names. Without a body the template has to lie roughly on the first scan.
"""

from __future__ import annotations

import argparse
import re
import shutil
from pathlib import Path

from capture4d.captures.capture import Capture, write_capture_description
from capture4d.colours.spaces import parse_colour
from capture4d.files.records import save_garment
from capture4d.geometry.mesh import boundary_loops
from capture4d.mesh_files.meshes import READABLE, read_mesh
from capture4d.types import Garment


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=Path)
    parser.add_argument("template", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--garment", required=True, help="colour of the garment, RRGGBB")
    parser.add_argument("--paint", help="colour of the painted borders, RRGGBB; none if left out")
    parser.add_argument("--fps", type=float, default=60.0)
    options = parser.parse_args()

    files = sorted(path for path in options.scans.iterdir() if path.suffix.lower() in READABLE)
    numbers = [re.findall(r"\d+", path.stem) for path in files]
    frame_ids = [int(found[-1]) for found in numbers] if all(numbers) else list(range(1, len(files) + 1))
    (options.capture / "scans").mkdir(parents=True, exist_ok=True)
    for frame_id, path in zip(frame_ids, files, strict=True):
        shutil.copyfile(path, options.capture / "scans" / f"{frame_id:06d}{path.suffix.lower()}")

    template = read_mesh(options.template).mesh
    loops = {f"border_{index}": loop for index, loop in enumerate(boundary_loops(template.faces))}
    save_garment(options.capture / "template.npz", Garment(template, loops if options.paint else {}))
    write_capture_description(
        Capture(
            path=options.capture,
            name=options.capture.name,
            fps=options.fps,
            frame_ids=tuple(sorted(frame_ids)),
            garment_colour=parse_colour(options.garment),
            boundary_colours=dict.fromkeys(loops, parse_colour(options.paint)) if options.paint else {},
        )
    )
    print(f"capture: {options.capture}, {len(files)} frames; now: capture4d run {options.capture} --output WORK")


if __name__ == "__main__":
    main()
