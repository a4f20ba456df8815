"""`capture4d offsets draw`, `edit`, `apply`: a frame's offsets as pictures, and the garment of changed ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from capture4d.captures.animations.config import RemovalConfig
from capture4d.cli.commands.files import FileOptions
from capture4d.cli.exit_codes import GOOD
from capture4d.cli.options import MeshOptions
from capture4d.settings import Whole
from wrinkles.offset_images.editing.config import DrawConfig

__all__ = ["OffsetsApply", "OffsetsDraw", "OffsetsEdit"]


@dataclass(frozen=True, kw_only=True)
class OffsetsDraw(FileOptions, MeshOptions):
    """Draw a registered frame as two pictures of offsets from the body, front and back, to be edited."""

    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder; holds registration/, whose template is bound to a body and has UVs."""
    frame: Whole
    """Frame to draw, by its number."""
    output: Path
    """Folder to write: front and back, layout.json, offsets.npz."""
    config: Annotated[DrawConfig, arg(name="")] = field(default_factory=DrawConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        pipeline.offsets_draw(self.work, self.frame, self.output, self.config, overwrite=self.overwrite)
        print(f"pictures: {self.output}; centimetres along tangent (red), bitangent (green), normal (blue)")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class OffsetsEdit(FileOptions, MeshOptions):
    """Change drawn pictures: shift, inflate, paint, and transfer wrinkles; any other program may do so as well."""

    pictures: Annotated[Positional[Path], arg(metavar="PICTURES")]
    """Folder of `offsets draw`, or of this command; it stays as it is."""
    operations: Annotated[Positional[Path], arg(metavar="OPERATIONS")]
    """JSON file {"operations": [{"do": "paint", "height_cm": 1.5, "side": "front", "stroke": [[0.5, 0.5]], "radius":
    0.05}]}; `do` is shift (du_cm, dv_cm), inflate (gain, add_cm), paint (height_cm) or transfer (from, scale,
    finer_than_texels)."""
    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder that the pictures were drawn of."""
    output: Path
    """Folder to write."""

    def __call__(self) -> int:
        from capture4d import pipeline

        pipeline.offsets_edit(self.pictures, self.operations, self.work, self.output, overwrite=self.overwrite)
        print(f"pictures: {self.output}")
        return GOOD


@dataclass(frozen=True, kw_only=True)
class OffsetsApply(FileOptions, MeshOptions):
    """Write the garment that changed pictures show, taken out of the body; where nothing changed it stays as it was."""

    pictures: Annotated[Positional[Path], arg(metavar="PICTURES")]
    """Folder of `offsets draw` or `offsets edit`, its pictures changed by whatever program."""
    work: Annotated[Positional[Path], arg(metavar="WORK")]
    """Work folder that they were drawn of."""
    output: Path
    """Mesh to write: ply, obj, glb or off."""
    config: Annotated[RemovalConfig, arg(name="removal")] = field(default_factory=RemovalConfig)

    def __call__(self) -> int:
        from capture4d import pipeline

        edited = pipeline.offsets_apply(self.pictures, self.work, self.output, self.config, overwrite=self.overwrite)
        if edited.removed is None:
            print("nothing was changed")
        else:
            after = edited.removed.after
            print(f"changed {100 * edited.moved_share:.1f} % of the vertices by {edited.moved_mm:.1f} mm in the mean; "
                  f"inside the body: {after.inside_percent:.2f} % of the vertices")  # fmt: skip
        print(f"mesh: {self.output}")
        return GOOD
