"""What `compare` sets side by side: one work folder and the models that others have learned, each opened once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from capture4d.app.compare.config import CompareConfig
from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import file_digest, read_json
from retarget.animation.garment_model import GarmentModel, load_garment_model
from retarget.model_folder import regressor_files
from wrinkles.frame_split import split_rows
from wrinkles.normal_maps.config import PairConfig
from wrinkles.normal_maps.inference import WrinkleModel, generator_path, load_model
from wrinkles.normal_maps.maps_stage import ensure_pairs
from wrinkles.normal_maps.pair_files import PairFolder, layout_digest
from wrinkles.normal_maps.pairs import PairTake
from wrinkles.normal_maps.template import MapTemplate
from wrinkles.normal_maps.train_stage import learned_takes
from wrinkles.offset_images.model_files import LearnedOffsets, find_offsets

__all__ = ["Inputs", "open_inputs"]


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """A registered take, its maps, and what was learned."""

    work: WorkFolder
    pairs: PairFolder
    template: MapTemplate
    """Referred to the pairs' own."""
    generator: WrinkleModel
    garment_model: GarmentModel | None
    offsets: LearnedOffsets | None
    upstream: Mapping[str, str]
    """Digests of all of it."""
    held_out: float
    """Share of the take's end that is compared, and `gap`, the frames before it that are not."""
    gap: int

    def held(self) -> PairTake:
        """The maps of the frames to compare: those held out whose scans could be read.

        Raises:
            InputError: there are none.
        """
        take = self.pairs.read()
        _, end = split_rows(len(take.frame_ids), held_out=self.held_out, gap=self.gap, name=take.name)
        held = take.part(end).without(self.work.failed_frames)
        if not len(held.frame_ids):
            raise InputError("expected held-out frames whose scans can be read, found none", where=self.work.path)
        return held

    def rows(self, held: PairTake) -> list[int]:
        """Where frames lie in the registered sequence.

        Raises:
            InputError: a frame is not there.
        """
        rows = {frame_id: row for row, frame_id in enumerate(self.work.registered.frame_ids.tolist())}
        for frame_id in held.frame_ids.tolist():
            if frame_id not in rows:
                raise InputError(f"frame {frame_id}: expected it among the registered frames, as it has a pair of "
                                 "maps, found none", where=self.work.path)  # fmt: skip
        return [rows[frame_id] for frame_id in held.frame_ids.tolist()]


def open_inputs(
    work: WorkFolder, model: Path, config: CompareConfig, *, garment_model: Path | None = None, workers: int = 1
) -> Inputs:
    """Open everything, and make the pairs of maps if need be.

    Raises:
        InputError: the work folder lacks registration or scans, a model is of another template, or the network learned
            from all frames.
    """
    weights = generator_path(model)
    generator = load_model(weights)
    pairs = ensure_pairs(work, PairConfig(map=generator.maps), workers=workers)
    known = _garment_model(work.path, garment_model)
    offsets = find_offsets(work.path, work.registered.garment, registration=pairs.registration)
    upstream = {
        "registration": pairs.registration,
        "pairs": pairs.digest,
        "model": file_digest([weights], root=weights.parent),
    }
    if known is not None:
        files = {path for name in known.regressors for path in regressor_files(known.folder, name)}
        upstream["garment model"] = known.digest
        upstream["regressors"] = file_digest(sorted(files), root=known.folder)
    if offsets is not None:
        upstream["offsets"] = offsets.digest
    _ = work.capture  # what is wrong with it is said before the work, not after
    template = MapTemplate.create(work.registered.garment, generator.maps).referred_to(pairs.template.vertices)
    if layout_digest(template.mesh, generator.maps.size) != generator.layout_digest:
        raise InputError(f"expected the template that {weights} was trained on, found another", where=work.path)
    if pairs.layout_digest != generator.layout_digest:
        raise InputError(f"expected maps laid out as {weights} has them ({generator.maps}), found {pairs.maps}",
                         where=pairs.path)  # fmt: skip
    held_out, gap = _network_split(weights, pairs) or _offsets_split(offsets) or (config.held_out, config.held_out_gap)
    return Inputs(work, pairs, template, generator, known, offsets, upstream, held_out, gap)


def _garment_model(work: Path, path: Path | None) -> GarmentModel | None:
    if path is None and not (work / "retarget" / "fit.json").is_file():
        return None
    return load_garment_model(work if path is None else path)


def _network_split(weights: Path, pairs: PairFolder) -> tuple[float, int] | None:
    """The frames that the network has not seen: its own split, if it learned from this take.

    Raises:
        InputError: it learned from all frames.
    """
    record_path = weights.parent / "stage.json"
    record = read_json(record_path) if record_path.is_file() else {}
    settings, takes = record.get("config", {}), record.get("upstream", {})
    learned = pairs.digest in takes.values() or pairs.registration in learned_takes(weights.parent)
    if settings.get("held_out", 0) > 0 and (learned or pairs.work.resolve().name in takes):
        return float(settings["held_out"]), int(settings["held_out_gap"])
    if learned:
        raise InputError(f"expected a network that has not seen all frames of {pairs.work}, found one that learned "
                         "from it without held-out frames", where=weights)  # fmt: skip
    return None


def _offsets_split(offsets: LearnedOffsets | None) -> tuple[float, int] | None:
    """The frames that offset images have not seen, if they held any out."""
    return (offsets.held_out, offsets.gap) if offsets is not None and offsets.held_out > 0 else None
