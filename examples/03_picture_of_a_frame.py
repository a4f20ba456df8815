"""Draw one frame of the demo: scan, registered garment, its distance to the true surface; and on another person.

capture4d demo --output out
python examples/03_picture_of_a_frame.py out frame.png --frame 24
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from capture4d.app.drawing.render import Drawn, View, frame_view, heat_colours, render
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import read_capture, read_scan
from capture4d.captures.evaluation import truth_distances
from capture4d.captures.truth import read_truth_model, read_truth_vertices
from capture4d.captures.work_folder import open_work
from capture4d.types import Mesh

CLOTH, PAINT, SKIN = (128, 152, 190), (255, 196, 0), (214, 190, 172)
WIDTH, HEIGHT = 300, 420
SHOWN_M = np.array([0.6, 1.12, 0.3])
"""Size of the box that a picture shows, so that people can be compared."""
WORST_MM = 1.0
"""Distance at which the colours end."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="what `capture4d demo` wrote")
    parser.add_argument("picture", type=Path, help="png to write")
    parser.add_argument("--frame", type=int, default=24, help="its number")
    options = parser.parse_args()

    capture = read_capture(options.demo / "capture")
    garment, body = posed(options.demo, options.frame)
    scan = read_scan(capture, options.frame)
    view = view_of(garment)
    paints = np.tile(np.array(CLOTH, np.uint8), (len(garment.vertices), 1))
    for loop in open_work(options.demo).registered.garment.loops.values():
        paints[loop] = PAINT
    truth = read_truth_model(capture)
    assert truth is not None
    surface = Mesh(read_truth_vertices(capture, options.frame), truth.fine.faces)
    errors_mm = 1e3 * truth_distances(garment, surface)[0]
    somebody, their_body = posed(options.demo / "other", options.frame)
    pictures = [
        draw([Drawn(scan.mesh, scan.colours)], view),
        draw([Drawn(garment, paints), Drawn(body, SKIN)], view),
        draw([Drawn(garment, heat_colours(errors_mm, high=WORST_MM)), Drawn(body, SKIN)], view),
        draw([Drawn(somebody, CLOTH), Drawn(their_body, SKIN)], view_of(somebody)),
    ]
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    few_colours = Image.fromarray(np.concatenate(pictures, axis=1)).quantize(256)  # a third of the file
    few_colours.save(options.picture, optimize=True)


def posed(work: Path, frame_id: int) -> tuple[Mesh, Mesh]:
    """The garment and the body of a frame."""
    opened = open_work(work)
    sequence = opened.registered
    row = sequence.frame_ids.tolist().index(frame_id)
    body, poses = opened.require_posed_body()
    of_body = pose_frame(with_shape(body, poses.shape), poses, poses.frame_ids.tolist().index(frame_id)).vertices()
    garment = sequence.garment.template.with_vertices(np.array(sequence.vertices[row]))
    return garment, body.template.with_vertices(of_body.astype(np.float32))


def view_of(garment: Mesh) -> View:
    """From the front left, on the garment's middle."""
    centre = (garment.vertices.min(axis=0) + garment.vertices.max(axis=0)) / 2
    return frame_view(centre - SHOWN_M / 2, centre + SHOWN_M / 2, "three_quarter", aspect=WIDTH / HEIGHT)


def draw(drawn: list[Drawn], view: View) -> np.ndarray:
    return render(drawn, view, width=WIDTH, height=HEIGHT)


if __name__ == "__main__":
    main()
