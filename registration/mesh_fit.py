"""Which way a template is brought onto a scan that nobody has told us anything about.

In this order, until the scan is reached:

    near       as a garment of the frame before, by the deformation graph; after the next where limbs are out of reach
    far        drawn there as a whole (`approach`)
    again      once more from there, narrowly, where that lost a part: two hands close to each other both go to the
               middle at first

From there the template settles with its own shape and lengths (`settle`), limbs that turned about themselves on a way
from afar are turned back (`untwisted`), and a vertex by vertex stage follows. What has two open borders or more is
tried as cloth besides, with lengths alone (`slid`).

Where `align` may, and a rigid motion brings the template far nearer, these are tried from there as well; from there
alone if nothing of the scan lies near the start. Then:

    wide       the same with wider votes, where limbs had to swing that are of the template's own size
    sized      all of these with the template made larger or smaller as a whole, where distances along the scan say so
    soft       growing and shrinking, for what is another of its kind

Each attempt is judged by what of the scan it leaves unreached, and what of itself away from the scan; the best counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from capture4d.errors import InputError
from capture4d.types import Garment, GarmentScan
from registration.alignment import align, fit_similarity
from registration.approach import approach, spread_evenly
from registration.border_strip import PaintRim
from registration.config import ApproachConfig, MeshRegistrationConfig, RegistrationConfig, Schedule
from registration.correspondences import mesh_normals
from registration.geodesic_signature import Likeness, geodesic_signatures, likeness
from registration.held_lengths import keeps_lengths, slid
from registration.limb_twist import untwisted
from registration.mesh_verdict import BORDER_MM, CLOTH_BORDER_MM, is_tight, reaches
from registration.quality import assess
from registration.register import FrameScan, prepare_frame, register_frame
from registration.scan_noise import held_against_noise, roughness
from registration.settling import settle
from registration.template import TemplateAnalysis, analyse_template

__all__ = ["Landmarks", "MeshFit", "fit_mesh"]

Landmarks = tuple[Int64[np.ndarray, " marks"], Float64[np.ndarray, "marks 3"]]
"""Template vertices, and their places on the scan."""
Signatures = tuple[Float64[np.ndarray, "verts quantiles"], Float64[np.ndarray, "points quantiles"]]

NORMAL_LENGTH = 0.03
"""What a normal turned by 60 degrees counts as among distances, metres, when attempts are compared."""
FARTHEST = 0.1
"""Beyond this, metres, one is as far off as another."""
SAMPLES = 4000
LIMB_AWAY, AWAY_SHARE = 0.06, 0.03
"""Where more than this share of the scan is farther than this from the template, metres, the way from nearby is tried
after the one from afar, if at all."""
BETTER = 0.8
"""A freer attempt has to bring the misfit down to this share, or lengths stay kept."""
CLEARLY = 0.6
"""A rigid motion is taken that brings the distance down to this share; limbs that swing look like one that does not."""
LIES_THERE = 0.02
"""Sum of the mean distances either way, metres, below which a template lies on the scan already."""
SWUNG = 0.85
"""Limbs had to swing where the way from afar brings the misfit down to this share of the near one's."""
SAME_SIZE = 0.98
"""Distances along a scan over those along the template of the same person: the median of 11 pairs (0.91 to 1.07)."""
OTHER_GAP = 0.03
"""Mean difference of signatures, metres, up to which the scan may show another of the template's kind."""
MOST_LOST = 0.2
"""Share of the template that may be far from a scan of another size; of half a person it is half."""
PART_LOST = 0.01
"""Share of the template away from the scan by which a hand may be lost: the way from afar is tried as well."""
SETTLED = 0.006
"""Mean distance of what has settled from the scan, metres, beyond which its own shape keeps it from there: cloth that
has folded, or grown. Then its shape is left to the scan, in these two stages."""
OPENINGS = 2
"""Border loops of a template from which it may be a garment, and is tried as cloth: others would pay for nothing."""
STIFF = Schedule(12, (0.03, 0.012), smooth=(300.0, 3.0), stretch=(10.0, 0.03), boundary=(0.3, 0.05))
"""After the way from afar: what is smooth stays smooth, while limbs turn and slide into their places."""
LOOSE = Schedule(8, (0.03, 0.012), smooth=(2.0, 0.2), stretch=(10.0, 0.03), boundary=(0.3, 0.05))
FROM_AFAR = ("far", "again", "wide")
"""Ways by `approach`."""
FREE = ("sized", "soft")
"""Ways that keep no lengths."""
LEAST_MARKS = 3
"""Landmarks that fix a rigid motion."""


@dataclass(frozen=True, slots=True, eq=False)
class MeshFit:
    """The attempt that counts."""

    vertices: Float64[np.ndarray, "verts 3"]
    start: Float64[np.ndarray, "verts 3"]
    """Where it started from, aligned or not."""
    analysis: TemplateAnalysis
    scan: FrameScan
    way: str
    """near, far, again, wide, sized, or soft."""


@dataclass(frozen=True, slots=True, eq=False)
class _Attempt:
    fit: MeshFit
    misfit: float
    reached: bool
    is_cloth: bool = False
    """It has reached a bare scan with its lengths: what is nearer without them overlaps where the scan has holes."""


class _Attempts:
    """What has been tried on one pair."""

    def __init__(
        self, garment: Garment, scan: GarmentScan, config: MeshRegistrationConfig, rim_points: np.ndarray | None
    ) -> None:
        self.garment, self.garment_scan, self.config, self.rim_points = garment, scan, config, rim_points
        self.kept = analyse_template(garment, config.registration)
        self.scan = prepare_frame(self.kept, scan, config.registration)
        self.rim: PaintRim | None = None
        if rim_points is not None and config.settle.rim > 0.0:
            self.rim = PaintRim.of(self.kept, rim_points, self.scan.border_points)
        self.made: list[_Attempt] = []
        self.fault: InputError | None = None

    @cached_property
    def measured(self) -> Signatures:
        """Signatures of the template's vertices and of the scan's points, alike or not."""
        mesh = self.garment_scan.mesh
        own = geodesic_signatures(self.kept.rest, self.kept.faces)
        return own, self.scan.surface.of_points(geodesic_signatures(mesh.vertices, mesh.faces))

    @cached_property
    def _likeness(self) -> Likeness:
        own, other = self.measured
        return likeness(own, self.kept.rest, other, self.scan.surface.points)

    @property
    def signatures(self) -> Signatures | None:
        """Of the template's vertices and of the scan's points; None where the two surfaces are not alike."""
        found, limits = self._likeness, self.config.approach
        alike = found.gap <= limits.signature_gap and limits.signature_size[0] <= found.size <= limits.signature_size[1]
        return (self.measured[0], found.levelled) if alike else None

    @cached_property
    def roughness(self) -> tuple[float, float]:
        """Of the scan, and of the template, metres."""
        mesh = self.garment_scan.mesh
        return roughness(mesh.vertices, mesh.faces), roughness(self.kept.rest, self.kept.faces)

    @property
    def other_size(self) -> float | None:
        """How much larger the scan is along its surface, where it seems to show another of the template's kind."""
        found, limits = self._likeness, self.config.approach
        low, high = limits.signature_size
        if low <= found.size <= high or found.gap > OTHER_GAP or not 0.7 < found.size < 1.4:
            return None
        return found.size / SAME_SIZE

    def add(self, way: str, start: np.ndarray, make: Callable[[], np.ndarray], scan: FrameScan | None = None) -> bool:
        """Make one more; whether it reaches the scan. What lies too far off for it is kept as the pair's fault.

        Args:
            scan: as this way sees it, if not as the others do.
        """
        scan = scan or self.scan
        try:
            vertices = make()
        except InputError as error:
            self.fault = self.fault or error
            return False
        fit, is_cloth = MeshFit(vertices, start, self.kept, scan, way), self.is_cloth(vertices, scan)
        reached = is_cloth or self.reaches(vertices, scan, BORDER_MM)
        self.made.append(_Attempt(fit, _misfit(self.kept, scan, vertices), reached, is_cloth))
        return reached

    def reaches(self, vertices: np.ndarray, scan: FrameScan, border_mm: float) -> bool:
        """Whether the template hugs all of the scan, and ends where the scan does."""
        tight = is_tight(assess(self.kept, scan, vertices, self.config.registration.quality))
        return tight and reaches(self.kept, scan, vertices, self.config.scan_fit, border_mm)

    @property
    def is_garment(self) -> bool:
        """Whether the template has openings as garments have: a face has one, a person none."""
        return len(self.kept.border.names) >= OPENINGS

    def is_cloth(self, vertices: np.ndarray, scan: FrameScan) -> bool:
        """Whether a garment does so with its lengths, on a scan without paint."""
        bare = self.is_garment and not len(scan.border_points)
        return bare and keeps_lengths(self.kept, vertices) and self.reaches(vertices, scan, CLOTH_BORDER_MM)

    @property
    def reached(self) -> bool:
        """Whether an attempt that keeps lengths has reached the scan. What has been made larger or smaller is another
        of the template's kind, whose lengths are others in detail as well."""
        return any(attempt.reached for attempt in self.made if attempt.fit.way not in FREE)

    @property
    def has_lost_a_part(self) -> bool:
        """Whether a part of the template lies away from a scan that is reached: the scan's own hand is smooth enough to
        be covered by a wrist. Or the scan lacks that part."""
        away = 1e3 * self.scan.surface.grid.query(self.best.fit.vertices)[0]
        return float((away > self.config.scan_fit.far_fail_mm).mean()) > PART_LOST

    @property
    def of_doubtful_size(self) -> bool:
        """Whether most of the template is on the scan, which is not reached, or from afar alone: limbs of another
        person's size can be folded up to lie on it. Half a person is no smaller one."""
        if not self.made or (self.reached and self.best.fit.way == "near"):
            return False
        away = 1e3 * self.scan.surface.grid.query(self.best.fit.vertices)[0]
        return float((away > self.config.scan_fit.far_fail_mm).mean()) <= MOST_LOST

    @property
    def swung(self) -> bool:
        """Whether the way from afar was needed: then the start is no start for others either."""
        near = [attempt.misfit for attempt in self.made if attempt.fit.way == "near"]
        others = [attempt.misfit for attempt in self.made if attempt.fit.way in FROM_AFAR]
        return bool(others) and min(others) < SWUNG * min(near, default=np.inf)

    @property
    def best(self) -> _Attempt:
        return min(self.made, key=_rank)


def _rank(attempt: _Attempt) -> tuple[bool, float]:
    return not attempt.is_cloth, attempt.misfit


def fit_mesh(
    garment: Garment,
    scan: GarmentScan,
    start: Float64[np.ndarray, "verts 3"],
    config: MeshRegistrationConfig,
    *,
    landmarks: Landmarks | None = None,
    rim_points: Float64[np.ndarray, "rim 3"] | None = None,
) -> MeshFit:
    """The template on the scan, by the first way that reaches it.

    Args:
        garment, scan, start: brought to the size that the settings are made for, metres.
        rim_points: where the paint of the scan's borders begins, likewise.
    Raises:
        InputError: nothing of the scan lies near the start, and `align` may not move it.
    """
    tried = _Attempts(garment, scan, config, rim_points)
    points = tried.scan.surface.points
    if config.align in ("rigid", "similarity"):
        start = align(start, points, with_scale=config.align == "similarity").apply(start)
    elif config.align == "auto" and landmarks is not None and len(landmarks[0]) >= LEAST_MARKS:
        start = fit_similarity(start[landmarks[0]], landmarks[1], with_scale=False).apply(start)
    start = _keeping_lengths(tried, start, landmarks)
    if config.lengths == "auto" and landmarks is None and tried.of_doubtful_size:
        _resized(tried, start)
    if config.lengths == "free" or not (tried.reached or config.lengths == "kept"):
        _freeing_lengths(tried, start)
    if not tried.made:
        assert tried.fault is not None, "an attempt is made or has a fault"
        raise tried.fault
    kept = [attempt for attempt in tried.made if attempt.fit.way not in FREE]
    if not kept:
        return tried.best.fit
    closest = min(kept, key=_rank)
    better = {"sized": closest.misfit, "soft": BETTER * closest.misfit}  # that the size is another is known already
    freer = [attempt for attempt in tried.made if attempt.fit.way in FREE and attempt.misfit < better[attempt.fit.way]]
    return min(freer or [closest], key=lambda attempt: attempt.misfit).fit


def _keeping_lengths(tried: _Attempts, start: np.ndarray, landmarks: Landmarks | None) -> np.ndarray:
    """Near, far and wide, until one reaches the scan; and the start, which a rigid motion may have brought there."""
    config, analysis, scan = tried.config, tried.kept, tried.scan
    own = config.registration
    bare = landmarks is None and not len(scan.border_points)  # painted borders are found from farther

    def placed(there: np.ndarray, *, turning: bool) -> np.ndarray:
        settled = _settled(tried, there, turning=turning)
        if float(scan.surface.grid.query(settled)[0].mean()) <= SETTLED:
            last = held_against_noise(_dense_alone(own), *tried.roughness)
            seen = scan if tried.rim is None else tried.rim.others(scan, settled)  # the rim has drawn its borders there
            shaped = register_frame(analysis, seen, settled, config=last).vertices
            return _nearer_as_cloth(tried, shaped, there) if bare else shaped
        shaped = there
        for schedule in (STIFF, LOOSE) if turning else (LOOSE,):
            dense = replace(own, dense=replace(own.dense, cold=schedule))
            shaped = register_frame(analysis, scan, shaped, config=_dense_alone(dense)).vertices
        return _nearer_as_cloth(tried, shaped, there)

    def carried(begin: np.ndarray) -> np.ndarray:
        there = register_frame(analysis, scan, begin, config=_coarse_alone(own)).vertices
        return placed(there, turning=False)

    def near(begin: np.ndarray) -> bool:
        return tried.add("near", begin, lambda: carried(begin))

    def drawn(begin: np.ndarray, votes: ApproachConfig, told: Signatures | None) -> np.ndarray:
        there = approach(analysis, scan.surface, begin, votes, signatures=told, landmarks=landmarks)
        return placed(there, turning=True)

    def far(begin: np.ndarray) -> bool:
        told = tried.signatures
        if tried.add("far", begin, lambda: drawn(begin, config.approach, told)):
            return True
        if told is None or tried.made[-1].fit.way != "far":
            return False
        reached = tried.made[-1].fit.vertices
        return tried.add("again", begin, lambda: drawn(reached, config.approach.again, told))

    movable = config.align == "auto" and landmarks is None
    if config.lengths == "free":
        return _moved_there(start, scan) if movable else start
    swinging = bare and _limbs_are_away(start, scan)
    if swinging and far(start):
        return start
    if landmarks is None and near(start):
        if bare and tried.has_lost_a_part:
            far(start)
        return start
    elsewhere = tried.fault is not None
    moved = _moved_there(start, scan) if movable and elsewhere else start
    if moved is start and not swinging and far(start):
        return start
    if tried.fault is not None and config.align == "none":
        raise tried.fault
    if movable and not elsewhere:
        moved = _moved_there(start, scan)
    if moved is not start and (near(moved) or far(moved)):
        return moved
    if tried.swung and (config.lengths == "kept" or tried.other_size is None):
        begin = tried.best.fit.start if moved is start else moved
        tried.add("wide", begin, lambda: drawn(begin, config.approach.wide, None))
        return begin
    return moved


def _nearer_as_cloth(tried: _Attempts, shaped: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The template as it was shaped; or slid from where it came with its lengths, if it reaches the scan so, or lies
    nearer to it."""
    analysis, scan = tried.kept, tried.scan
    if not tried.is_garment:
        return shaped
    cloth = slid(analysis, scan, there, _dense_alone(tried.config.registration), tried.roughness)
    if tried.is_cloth(cloth, scan):
        return cloth
    nearer = keeps_lengths(analysis, cloth) and _misfit(analysis, scan, cloth) < _misfit(analysis, scan, shaped)
    return cloth if nearer else shaped


def _settled(tried: _Attempts, there: np.ndarray, *, turning: bool) -> np.ndarray:
    """The template settled on the scan.

    Args:
        turning: once more with its limbs turned back, if that brings it nearer.
    """
    analysis, scan, config = tried.kept, tried.scan, tried.config
    settled = settle(analysis, scan, there, config.settle, config.registration, rim=tried.rim)
    turned = untwisted(analysis, scan.surface, settled) if turning else None
    if turned is None:
        return settled
    again = settle(analysis, scan, turned, config.settle, config.registration, rim=tried.rim)
    return min(settled, again, key=lambda vertices: _misfit(analysis, scan, vertices))


def _limbs_are_away(start: np.ndarray, scan: FrameScan) -> bool:
    """Whether most of the scan lies around the template, but limbs of it beyond what is reached from nearby."""
    points = scan.surface.points
    away = KDTree(start).query(points[spread_evenly(points, SAMPLES)])[0]
    return float((away > LIMB_AWAY).mean()) > AWAY_SHARE and float(np.median(away)) < LIMB_AWAY


def _resized(tried: _Attempts, start: np.ndarray) -> None:
    """The template made as large as the scan as a whole, and brought there with the lengths it has then."""
    factor = tried.other_size
    if factor is None:
        return
    rest, middle = tried.kept.rest, start.mean(axis=0)
    template = tried.garment.template.with_vertices((factor * rest).astype(np.float32))
    own = _Attempts(replace(tried.garment, template=template), tried.garment_scan, tried.config, tried.rim_points)
    own.measured = factor * tried.measured[0], tried.measured[1]
    begin = _moved_there(middle + factor * (start - middle), own.scan)
    _keeping_lengths(own, begin, None)
    if own.made:
        best = own.best
        fit = MeshFit(best.fit.vertices, best.fit.start, tried.kept, tried.scan, "sized")
        tried.made.append(_Attempt(fit, best.misfit, best.reached))


def _freeing_lengths(tried: _Attempts, start: np.ndarray) -> None:
    """Soft, from the start; where limbs had to swing, from where the lengths let them come as well."""
    soft = tried.config.soft
    analysis = analyse_template(tried.garment, soft)
    scan = prepare_frame(analysis, tried.garment_scan, soft)

    def softly(there: np.ndarray, settings: RegistrationConfig) -> None:
        tried.add("soft", start, lambda: register_frame(analysis, scan, there, config=settings).vertices, scan)

    if tried.swung:
        softly(tried.best.fit.vertices, _dense_alone(soft))
    softly(start, soft)


def _moved_there(start: np.ndarray, scan: FrameScan) -> np.ndarray:
    """The start, moved rigidly onto the scan if it is far nearer then."""
    own, other = spread_evenly(start, SAMPLES), spread_evenly(scan.surface.points, SAMPLES)

    def away(points: np.ndarray) -> float:
        there = KDTree(scan.surface.points).query(points[own])[0]
        back = KDTree(points).query(scan.surface.points[other])[0]
        return float(there.mean() + back.mean())

    now = away(start)
    if now < LIES_THERE:
        return start
    moved = align(start, scan.surface.points, with_scale=False).apply(start)
    return moved if away(moved) < CLEARLY * now else start


def _coarse_alone(config: RegistrationConfig) -> RegistrationConfig:
    """What settles next needs to lie on the scan only."""
    return replace(config, dense=replace(config.dense, cold=replace(config.dense.cold, steps=0)))


def _dense_alone(config: RegistrationConfig) -> RegistrationConfig:
    """Where the template lies on the scan already, nodes only push it about."""
    cold = replace(config.coarse.cold, steps=0)
    return replace(config, coarse=replace(config.coarse, cold=cold))


def _misfit(analysis: TemplateAnalysis, scan: FrameScan, vertices: np.ndarray) -> float:
    """Mean distance from scan to template and from template to scan, in position and normal, metres."""
    normals = mesh_normals(vertices, analysis.faces)
    own = spread_evenly(vertices, SAMPLES)
    other = spread_evenly(scan.surface.points, SAMPLES)
    here = np.concatenate([vertices, NORMAL_LENGTH * normals], axis=1)
    there = np.concatenate([scan.surface.points, NORMAL_LENGTH * scan.surface.normals], axis=1)
    back, forth = KDTree(here).query(there[other])[0], KDTree(there).query(here[own])[0]
    return float(np.minimum(back, FARTHEST).mean() + np.minimum(forth, FARTHEST).mean())
