"""Settings of the registration, split by role. Standard library only: the command line imports this to print its help.

Energies (each a mean of squares, in m^2, so that a weight keeps its meaning when the template, the number of nodes or
the scan get finer; the paper gives its weights without units and says "triangle" where its unknowns are grid nodes):

    E_data    mean over template vertices of the squared distance to the matched scan plane
    E_rigid   node spacing squared times the mean over nodes of the six squared violations of A^T A = I
    E_smooth  mean over pairs of neighbouring nodes of the squared disagreement about the neighbour's position
    E_bound   mean over template border vertices of the squared distance to their targets

`PAPER` takes the printed constants 500, 500, 10 in these units (DeepWrinkles, ECCV 2018, Eq. 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Annotated, Literal

from capture4d.settings import Cosine, Count, NonNegative, Percent, Positive, Range, Share, Whole, settings

__all__ = [
    "PAIR",
    "PAPER",
    "PRESETS",
    "SOFT",
    "ApproachConfig",
    "BoundaryConfig",
    "CoarseConfig",
    "ColourConfig",
    "DataConfig",
    "DenseConfig",
    "GraphConfig",
    "LinearSolverConfig",
    "MeshRegistrationConfig",
    "QualityConfig",
    "RegistrationConfig",
    "ScanFitConfig",
    "Schedule",
    "SequenceConfig",
    "SettleConfig",
]

BoundaryRule = Literal["argmax", "nearest", "mean", "none"]


@settings
class GraphConfig:
    """The deformation graph, sampled on the template once."""

    nodes: Count = 300
    """Number of affine nodes, spread along the surface."""
    nodes_per_vertex: Count = 6
    """How many nodes move one vertex."""
    vertices: Whole = 1000
    """Template vertices that carry the data term of the coarse stage, besides all border vertices; 0 for all."""


@settings
class LinearSolverConfig:
    """Block-Jacobi preconditioned conjugate gradients inside each Gauss-Newton step."""

    tolerance: Annotated[float, Range(above=0, below=1)] = 1e-2
    """Relative residual at which to stop; tighter changes nothing but the time."""
    max_iterations: Count = 120
    """Iterations at most."""


@settings
class DataConfig:
    """Which scan points a template vertex may be pulled to."""

    rule: Literal["plane", "both_ways"] = "plane"
    """plane: each vertex to the plane at its nearest scan point; both_ways: the scan's points vote as well."""
    max_voters: Count = 20000
    """Scan points that vote under both_ways."""
    normal_length: NonNegative = 0.002
    """What a normal turned by 60 degrees counts as among distances under both_ways, metres."""
    min_normal_cosine: Cosine = 0.4
    """Reject a match whose normals differ by more than this angle's cosine."""
    other_part_share: Share = 0.5
    """Reject a match if another part of the template lies nearer to it than this share of its distance: what is nearest
    to cloth in an armpit is the scan of the sleeve that hides it (rule plane); 0 rejects none."""
    robust_scale: Positive = 0.4
    """Scale of the Geman-McClure weight, as a share of the distance gate."""
    normals: Literal["scan", "both"] = "scan"
    """Whose normal the plane has, under rule plane: the scan's, or the mean of both (Rusinkiewicz
    2019), by which a template slides and turns into its place in fewer steps."""
    point_share: Share = 0.0
    """Weight of the tangential part of the match: 0 is point-to-plane, 1 is point-to-point."""
    smoothing_passes: Whole = 1
    """Laplacian passes over the scan before its normals are taken."""
    unshrunk: bool = False
    """Follow each by a pass outwards: a scan as coarse as 8 mm loses half a millimetre of its limbs otherwise."""


@settings
class BoundaryConfig:
    """Painted borders: DeepWrinkles Eq. 2 and its variants."""

    coarse_rule: BoundaryRule = "argmax"
    """Which of a border vertex's voters is its target in the coarse stage; argmax is Eq. 2."""
    dense_rule: BoundaryRule = "mean"
    """The same in the dense stage."""
    along_curve: bool = True
    """Drop the residual along the border, so that border vertices are not slid along the curve (dense stage)."""
    gate: Positive = 0.12
    """Farthest target, metres."""
    max_points: Count = 3000
    """Scan border points are thinned to this many."""


@settings
class ColourConfig:
    """What is printed on the cloth, in the dense stage: it shows how the cloth slides."""

    use: Literal["auto", "off"] = "auto"
    """auto: where the cloth is printed, which the scans tell; off: never."""
    print: str | None = None
    """Picture of the print over the template's UVs: over 0 to 1, as textures lie; over the bounding box of UVs that are
    a pattern in metres, or reach beyond. If absent, the print is learned from the first frames."""
    weight: NonNegative = 2.0
    """Where the colours are as steep as usual, beside 1 of the distance to the scan's planes."""
    robust: Positive = 0.3
    """Scale of the Geman-McClure weight, as a share of the colours' variance."""
    steps: Whole = 0
    """Gauss-Newton steps beyond those of the dense stage, over all of which its weights move."""
    sharp_steps: Count = 2
    """Last steps, on colours that are blurred narrowly; those before them are on widely blurred ones."""
    stretch: NonNegative = 0.6
    """Least weight of edge lengths: cloth that is held by its colours does not creep where its lengths are wrong, and
    between them the lengths say where it is."""


@settings
class Schedule:
    """A run of Gauss-Newton steps whose weights and gates move geometrically from first to last."""

    steps: Whole
    """Gauss-Newton steps; correspondences are renewed before each."""
    gate: tuple[Positive, Positive]
    """Distance gate of the data term, metres, first and last step."""
    rigid: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Weight of E_rigid, first and last step."""
    smooth: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Weight of E_smooth (coarse) or of the displacement's bending (dense)."""
    stretch: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Weight of lengths against the template's: between nodes (coarse), along edges (dense)."""
    anchor: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Weight of the tangential distance to the start (dense stage)."""
    boundary: tuple[NonNegative, NonNegative] = (2.0, 2.0)
    """Weight of E_bound."""


@settings
class CoarseConfig:
    """The deformation graph stage."""

    cold: Schedule = Schedule(8, (0.12, 0.05), rigid=(100.0, 3.0), smooth=(60.0, 2.0), stretch=(100.0, 10.0))
    """From a skinned template or another distant start."""
    warm: Schedule = Schedule(2, (0.05, 0.03), rigid=(25.0, 25.0), smooth=(30.0, 30.0), stretch=(40.0, 40.0))
    """From the frame before."""
    start_lengths: bool = True
    """In the warm schedule, hold nodes to their distances in the start, not in the template: folds have shortened
    them, and where cloth bunches the template's distances push it off its place."""
    compression: NonNegative = 0.3
    """Share of the stretch weight that resists shortening, in the warm schedule."""
    cold_compression: NonNegative = 1.0
    """The same in the cold schedule, where nodes are held to the template's distances."""


@settings
class DenseConfig:
    """The per-vertex stage."""

    cold: Schedule = Schedule(12, (0.03, 0.012), smooth=(0.05, 0.02), stretch=(10.0, 0.03), boundary=(0.3, 0.05))
    """After a cold coarse stage."""
    warm: Schedule = Schedule(3, (0.02, 0.012), smooth=(3.0, 0.2), stretch=(10.0, 5.0), boundary=(0.2, 0.1))
    """After a warm coarse stage. Bending is stiff at first, for what is nearest pulls soft cloth along itself; lengths
    are held to the end, by scans that show what folds take up: coarser ones than 3 mm less."""
    plasticity: Share = 0.5
    """Share of the bending that is forgiven between steps: 0 keeps the coarse stage's shape, 1 only damps change."""
    compression: NonNegative = 1.0
    """Share of the stretch weight that resists shortening: folds finer than the template's edges shorten them."""
    fold_lengths: bool = True
    """In the warm schedule, hold edges to the length that the folds in the scan leave them, instead of their length on
    the pattern. From a distant start the folds seen around an edge are not yet its own."""


@settings
class SequenceConfig:
    """How a take is cut up and where each frame starts."""

    segment: Count = 240
    """Frames of a segment, more or less a quarter: it begins where the pose is nearest to that of the template.
    Segments are registered side by side, on as many processes and machines as there are, and joined."""
    overlap: Whole = 24
    """Frames before its first one from which a segment is registered, starting from the skinned template. In the last
    two thirds of them the segment before fades into it."""
    seam_mm: NonNegative = 0.5
    """What that may add to a frame's motion, mean over the vertices; a segment that is farther from the one before is
    registered anew from that one's end, once it is done."""
    start: Literal["best", "previous", "skinned"] = "best"
    """Start of a frame: the frame before, as it lies and moved with the body; the skinned pose; or a blend of them by
    how near each is to the scan."""
    relax: NonNegative = 0.4
    """Trust in the skinned pose within the blend, beside 1 in the frame before: pulls cloth back that has drifted."""
    cold_above: NonNegative = 0.004
    """Take the cold schedule when the median distance from start to scan exceeds this, metres."""


@settings
class QualityConfig:
    """When a frame is good, to be checked, or failed."""

    fit_check_mm: NonNegative = 1.0
    """Mean distance to the scan above which a frame is to be checked."""
    fit_fail_mm: NonNegative = 5.0
    """Mean distance to the scan above which a frame has failed."""
    boundary_check_mm: NonNegative = 3.0
    """Mean border error above which a frame is to be checked."""
    boundary_fail_mm: NonNegative = 15.0
    """Mean border error above which a frame has failed."""
    stretch_check: NonNegative = 1.4
    """99th percentile of edge stretch above which a frame is to be checked."""
    stretch_fail: NonNegative = 2.5
    """99th percentile of edge stretch above which a frame has failed."""
    flipped_check_percent: Percent = 1.0
    """Share of faces against the scan's normals above which a frame is to be checked."""
    intersections_check_percent: Percent = 0.21
    """Share of faces that cut another face above which a frame is to be checked: 20 of a template with 5,000 vertices.
    Where cloth cuts itself it is guessed, as in the armpits of hanging arms."""
    unfitted_mm: NonNegative = 5.0
    """A vertex farther from a scan that shows it is not fitted; what lies farther behind cloth that is on the scan is
    hidden. 0: neither is looked for."""
    unfitted_check_percent: Percent = 0.2
    """Share of such vertices above which a frame is to be checked: 10 of a template with 5,000."""
    region_far_percent: Percent = 5.0
    """Share of a region's vertices, of those with scan data, more than 2 mm from it, above which a frame is to be
    checked."""
    region_cut_percent: Percent = 12.0
    """Share of a region's faces that cut another face above which a frame is to be checked."""
    region_creased_percent: Percent = 12.0
    """Share of a region's edges folded by more than 60 degrees above which a frame is to be checked."""
    min_covered_percent: Percent = 40.0
    """Share of vertices with scan data below which a frame has failed."""


@settings
class RegistrationConfig:
    """Everything the registration stage reads."""

    graph: GraphConfig = field(default_factory=GraphConfig)
    solver: LinearSolverConfig = field(default_factory=LinearSolverConfig)
    data: DataConfig = field(default_factory=DataConfig)
    boundary: BoundaryConfig = field(default_factory=BoundaryConfig)
    coarse: CoarseConfig = field(default_factory=CoarseConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    colour: ColourConfig = field(default_factory=ColourConfig)
    quality: QualityConfig = field(default_factory=QualityConfig)


PAPER_SCHEDULE = Schedule(30, (0.12, 0.12), rigid=(500.0, 500.0), smooth=(500.0, 500.0), boundary=(10.0, 10.0))
NO_STEPS = Schedule(0, (0.03, 0.012))

PAPER = RegistrationConfig(
    graph=GraphConfig(nodes=800, vertices=0),
    data=DataConfig(point_share=1.0, smoothing_passes=0, other_part_share=0.0),
    boundary=BoundaryConfig(coarse_rule="argmax", dense_rule="argmax", along_curve=False),
    coarse=CoarseConfig(cold=PAPER_SCHEDULE, warm=PAPER_SCHEDULE),
    dense=DenseConfig(cold=NO_STEPS, warm=NO_STEPS),
    sequence=SequenceConfig(start="skinned", relax=0.0),
    colour=ColourConfig(use="off"),
)
"""DeepWrinkles as printed: constant weights, no dense stage."""

PRESETS: Mapping[str, RegistrationConfig] = {"default": RegistrationConfig(), "paper": PAPER}

SOFT = RegistrationConfig(
    graph=GraphConfig(nodes=300, vertices=0),
    data=DataConfig(
        rule="both_ways",
        point_share=1.0,
        smoothing_passes=0,
        robust_scale=1.0,
        min_normal_cosine=0.2,
        normal_length=0.06,
    ),
    coarse=CoarseConfig(
        cold=Schedule(40, (0.3, 0.12), rigid=(0.1, 0.01), smooth=(1000.0, 1.0)),
        cold_compression=0.5,
    ),
    dense=DenseConfig(
        cold=Schedule(40, (0.12, 0.06), smooth=(30.0, 0.05)),
        plasticity=0.0,
        compression=0.5,
        fold_lengths=False,
    ),
)


PAIR = RegistrationConfig(
    data=DataConfig(normals="both", smoothing_passes=4, unshrunk=True),
    dense=DenseConfig(
        cold=Schedule(
            4, (0.012, 0.012), smooth=(20.0, 0.2), stretch=(10.0, 0.03), anchor=(0.1, 0.02), boundary=(0.02, 0.02)
        ),
        plasticity=0.0,
    ),
    quality=QualityConfig(intersections_check_percent=10.0, unfitted_mm=0.0),
)
"""Two meshes of one thing. The dense stage comes after the template has settled, and what has settled hardly slides."""


@settings
class SettleConfig:
    """Between the way there and the dense stage: limbs turn and slide into their places with the template's shape."""

    steps: Count = 12
    """Gauss-Newton steps; correspondences are renewed before each."""
    gate: tuple[Positive, Positive] = (0.03, 0.012)
    """Distance gate of the data term, metres, first and last step."""
    bending: tuple[NonNegative, NonNegative] = (300.0, 3.0)
    """Weight of how far vertices are off their neighbourhoods as the template has them, turned as they lie."""
    stretch: tuple[NonNegative, NonNegative] = (10.0, 0.03)
    """Weight of lengths along edges against the template's."""
    boundary: tuple[NonNegative, NonNegative] = (0.3, 0.02)
    """Weight of E_bound. The shape knows the border better than painted points that a scan has lost here and there."""
    rim: NonNegative = 0.1
    """Weight of the inner rim of the borders' paint in its place, where the paint is equally wide."""


@settings
class ApproachConfig:
    """From a start that is far off: every scan point votes among all template vertices."""

    steps: Count = 20
    """Gauss-Newton steps; the votes are counted anew before each."""
    width: tuple[Positive, Positive] = (0.06, 0.012)
    """Standard deviation of the Gaussian by which a scan point divides its vote, metres, first and last step."""
    wider: Positive = 0.1
    """The same in the first step where signatures have failed."""
    normal: NonNegative = 3.0
    """How much less a vertex counts whose normal turns away: exp(-normal (1 - cosine))."""
    reach: Positive = 3.5
    """A scan point farther from all vertices than so many standard deviations has hardly a vote."""
    signature: Positive = 0.03
    """Standard deviation of geodesic signatures between scan and template, metres."""
    signature_weight: tuple[NonNegative, NonNegative] = (1.0, 0.02)
    """Weight of the signatures in the votes, beside 1 of the distance, first and last step."""
    again_weight: Positive = 0.3
    """The same in the first step of a second attempt, from where the first has led."""
    again_width: Positive = 0.06
    """First width of the Gaussian there."""
    signature_width: Positive = 0.15
    """First width of the Gaussian where signatures tell which vertices a scan point may vote for: a limb may swing by
    several of these."""
    signature_reach: Positive = 8.0
    """`reach` where they do."""
    signature_gap: NonNegative = 0.012
    """Mean difference, metres, between how signatures are distributed over the scan and over the template, above which
    they are not compared: the scan shows another part, or joins what the template does not. Up to 0.008 for the same
    person (11 pairs), 0.014 to 0.042 for a part of one."""
    signature_size: tuple[Positive, Positive] = (0.89, 1.1)
    """Distances along the scan over those along the template within which they are compared. Of the same person they
    were 0.91 to 1.07, of others 0.85, 0.87, 1.04 and 1.13."""
    rigid: tuple[NonNegative, NonNegative] = (5.0, 1.0)
    """Weight of E_rigid, first and last step."""
    smooth: tuple[NonNegative, NonNegative] = (0.5, 0.1)
    """Weight of E_smooth."""
    stretch: tuple[NonNegative, NonNegative] = (10.0, 3.0)
    """Weight of the distances between nodes against the template's."""
    landmarks: NonNegative = 3.0
    """Weight of the mean squared distance between landmarks, where some are given."""
    vertices: Count = 1500
    """Template vertices that may be voted for."""
    voters: Count = 2000
    """Scan points that vote."""

    @property
    def again(self) -> ApproachConfig:
        """A second attempt, from where the first has led."""
        weight = (self.again_weight, self.signature_weight[1])
        return replace(self, signature_width=self.again_width, signature_weight=weight)

    @property
    def wide(self) -> ApproachConfig:
        """An attempt by nearness alone, from farther."""
        return replace(self, width=(self.wider, self.width[1]))


@settings
class ScanFitConfig:
    """When two meshes belong together: limits beside those of `QualityConfig`, for a template of 1.2 m."""

    check_mm: NonNegative = 1.0
    """Mean distance from the scan to the template above which the result is to be checked."""
    fail_mm: NonNegative = 2.5
    """The same above which it has failed."""
    far_check_mm: NonNegative = 5.0
    """95th percentile of that distance above which the result is to be checked."""
    far_fail_mm: NonNegative = 12.0
    """The same above which it has failed: a limb of the scan is not reached."""
    beyond_check_percent: Percent = 3.0
    """Share of the scan beyond the template's open borders above which the result is to be checked: the scan shows more
    than the template, or the template has not slid there."""
    lost_check_percent: Percent = 2.0
    """Share of the template farther than `far_fail_mm` from the scan above which the result is to be checked: what is
    not scanned follows its neighbours, and swings as they do."""
    lost_fail_percent: Percent = 5.0
    """The same above which it has failed, where the scan is doubtfully reached as well: a limb went elsewhere. Where
    all of the scan is reached, it only shows less."""
    lost_swung_fail_percent: Percent = 25.0
    """The same above which it has failed, where it has swung by more than `swung_check_mm` as well: another thing."""
    swung_check_mm: NonNegative = 45.0
    """Mean way of the template's vertices from the start, beyond the best rigid motion, above which the result is to be
    checked: how limbs have turned and slid under their clothes is known less well the farther they have swung."""
    flipped_fail_percent: Percent = 5.0
    """Share of faces against the scan's normals above which it has failed."""
    cut_fail_percent: Percent = 30.0
    """Share of faces that cut another face above which it has failed."""


@settings
class MeshRegistrationConfig:
    """Any template onto any scan."""

    border_colour: str = ""
    """Paint on the scan's borders, RRGGBB; empty where none is painted."""
    units: Literal["m", "cm", "mm", "in", "auto"] = "auto"
    """Of both files; decides the millimetres of the report, never the result. auto: metres if the template's bounding
    box is less than 8 across, centimetres if less than 200, else millimetres."""
    align: Literal["auto", "none", "rigid", "similarity"] = "auto"
    """Move the template onto the scan first, with scale for similarity; none if the two already lie on each other.
    auto: as they lie, and moved rigidly where that leads nowhere."""
    lengths: Literal["auto", "kept", "free"] = "auto"
    """kept: the scan shows the template's own thing, moved, and distances along the surface stay. free: it shows
    another of its kind, as another face, and the template grows and shrinks. auto: kept, and free where the scan is not
    reached so."""
    registration: RegistrationConfig = PAIR
    """Settings where lengths are kept, for a template whose diagonal is 1.2 m."""
    settle: SettleConfig = SettleConfig()
    """Settings of what follows on the way there, from near or afar."""
    soft: RegistrationConfig = SOFT
    """Settings where lengths are free."""
    approach: ApproachConfig = ApproachConfig()
    """Settings of the way there where the template starts far off."""
    scan_fit: ScanFitConfig = ScanFitConfig()
    """When the scan counts as reached."""
