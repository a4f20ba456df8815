"""Learned garments as graphs: what `GarmentModel.vertices` computes of a frame but for taking cloth out of the body.

Inputs are what this project hands on between its parts: control vectors (`retarget.regression.controls`) and the
transforms of the joints, rest pose to world. Both are the caller's: they follow from the motion by the formulas in
docs/how-to/run-elsewhere.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from capture4d.app.onnx_models.graph import Graph, Name
from capture4d.app.onnx_models.layers import lstm_answer, perceptron
from capture4d.errors import InputError
from retarget.animation.bodies import captured_person, retargeted_mean
from retarget.animation.garment_model import GarmentModel
from retarget.mixture.heads import Head
from retarget.mixture.kernel_ridge import KernelRidge
from retarget.mixture.predictors import SPEAKS, Ensemble
from retarget.mixture.styled_garment import StyledGarment, WornGarment
from retarget.regression.ensemble import EnsembleRegressor
from retarget.regression.kernel import KernelRegressor
from retarget.regression.known_range import FADED, FADED_POSES, NEAREST_SHARE, NUMBERS_OF_A_RADIAN, BoundedRegressor
from retarget.regression.linear import LinearRegressor
from retarget.regression.lstm import LstmRegressor
from retarget.regression.regressors import Regressor, Scales, Trust

__all__ = ["garment_graph", "styled_graph"]


def garment_graph(model: GarmentModel, regressor: Regressor, beta: Sequence[float] | None) -> Graph:
    """Inputs `controls` (frames, controls) and `transforms` (frames, joints, 4, 4), outputs `vertices`
    (frames, verts, 3), metres, and `coefficients` (frames, shapes); all float64. Frames follow each other.

    Args:
        beta: body shape of the wearer; None: whom the garment was learned on.
    Raises:
        InputError: the regressor hears its own answers, which a graph without a loop cannot.
    """
    person = model.person(beta)
    mean = retargeted_mean(model.model, captured_person(model.model, model.body), person)
    weights = model.model.garment.skin_weights
    assert weights is not None
    graph = Graph("garment")
    controls = graph.input("controls", ("frames", regressor.layout.size))
    transforms = graph.input("transforms", ("frames", weights.shape[1], 4, 4))
    coefficients = _answer(graph, regressor, controls)
    basis = model.model.basis.reshape(len(model.model.basis), -1)
    offsets = graph.matrix(coefficients, graph.constant(basis))
    rest = graph.plus(graph.reshaped(offsets, -1, len(mean), 3), graph.constant(mean.astype(np.float32)))
    graph.output("vertices", _skinned(graph, rest, weights, transforms), ("frames", len(mean), 3))
    graph.output("coefficients", coefficients, ("frames", len(model.model.basis)))
    return graph


def _skinned(graph: Graph, rest: Name, weights: np.ndarray, transforms: Name) -> Name:
    """Linear blend skinning: v = (sum_j w_j T_j) v_rest."""
    joints = weights.shape[1]
    rows = graph.add("Slice", transforms, graph.whole(0), graph.whole(3), graph.whole(2))
    flat = graph.reshaped(rows, 0, joints, 12)
    blended = graph.reshaped(graph.matrix(graph.constant(weights), flat), 0, len(weights), 3, 4)
    turned = graph.matrix(graph.columns(blended, 0, 3), graph.reshaped(rest, 0, 0, 3, 1))
    return graph.reshaped(graph.plus(turned, graph.columns(blended, 3, 4)), 0, 0, 3)


# --- regressors --------------------------------------------------------------------------------------------------


def _answer(graph: Graph, regressor: Regressor, controls: Name) -> Name:
    if regressor.layout.config.history:
        raise InputError("expected a regressor that does not hear its own answers, found one with a history")
    match regressor:
        case EnsembleRegressor():
            first = _answer(graph, regressor.first, controls)
            second = _answer(graph, regressor.second, graph.chosen(controls, regressor.columns, 1))
            first = graph.times(first, graph.constant(np.float64(1 - regressor.share)))
            return graph.plus(first, graph.times(second, graph.constant(np.float64(regressor.share))))
        case BoundedRegressor():
            return _bounded(graph, regressor, controls)
        case LinearRegressor():
            known = _standardised(graph, regressor.scales, controls)
            said = graph.matrix(known, graph.constant(regressor.matrix))
            return graph.plus(said, graph.constant(regressor.intercept))
        case KernelRegressor():
            known = _standardised(graph, regressor.scales, controls)
            return _by_kernels(graph, regressor, known)
        case LstmRegressor():
            return _by_network(graph, regressor, controls)
        case _:
            raise InputError(f"expected a regressor that is known, found {type(regressor).__name__}")


def _standardised(graph: Graph, scales: Scales, controls: Name) -> Name:
    return graph.over(graph.minus(controls, graph.constant(scales.control_mean)), graph.constant(scales.control_std))


def _by_kernels(graph: Graph, regressor: KernelRegressor, known: Name) -> Name:
    """A sum over the learned frames, each weighted by its likeness: `capture4d.learning.kernels`."""
    total: Name | None = None
    for number, (view, share) in enumerate(zip(regressor.views, regressor.shares, strict=True)):
        theirs = regressor.frames.astype(np.float64) @ view.astype(np.float64)
        ours = graph.matrix(known, graph.constant(view))
        alike = graph.times(_gaussian(graph, ours, theirs), graph.constant(np.float64(share)))
        if number == 0 and regressor.line:
            line = graph.matrix(ours, graph.constant(regressor.line * theirs.T))
            alike = graph.plus(alike, line)
        total = alike if total is None else graph.plus(total, alike)
    assert total is not None
    return graph.plus(graph.matrix(total, graph.constant(regressor.answers)), graph.constant(regressor.middle))


def _gaussian(graph: Graph, ours: Name, theirs: np.ndarray) -> Name:
    """exp(-|a - b|^2 / 2) of rows and others."""
    half = graph.at_least(_squares(graph, ours, theirs), 0.0)
    return graph.add("Exp", graph.times(half, graph.constant(np.float64(-0.5))))


def _squares(graph: Graph, ours: Name, theirs: np.ndarray) -> Name:
    """(rows, others) squared distances, which rounding may leave below 0."""
    own = graph.summed(graph.times(ours, ours), -1)
    both = graph.matrix(ours, graph.constant(-2 * theirs.astype(np.float64).T))
    return graph.plus(graph.plus(own, graph.constant((theirs.astype(np.float64) ** 2).sum(axis=1)[None])), both)


def _by_network(graph: Graph, regressor: LstmRegressor, controls: Name) -> Name:
    """Of each frame the window that ends with it; before the first frame, the first."""
    known, reach = _standardised(graph, regressor.scales, controls), regressor.config.window - 1
    shapes = len(regressor.scales.std)
    first = graph.add("Slice", known, graph.whole(0), graph.whole(1), graph.whole(0))
    padded = graph.add("Concat", *([first] * reach), known, axis=0) if reach else known
    window = [
        graph.add("Slice", padded, graph.whole(reach - back), graph.whole(-back), graph.whole(0))
        for back in range(reach, 0, -1)
    ]
    said = graph.times(
        lstm_answer(graph, regressor.network, [*window, known], shapes), graph.constant(regressor.scales.std)
    )
    return said if regressor.linear is None else graph.plus(said, _answer(graph, regressor.linear, controls))


# --- what is known -----------------------------------------------------------------------------------------------


def _bounded(graph: Graph, regressor: BoundedRegressor, controls: Name) -> Name:
    """`ControlRange.bounded`, then the answer, then `CoefficientRange.faded`."""
    layout, known, limits = regressor.layout, regressor.controls, regressor.coefficients
    parts = []
    for (_, part, moves), largest in zip(layout.parts, known.largest.astype(np.float64), strict=True):
        value = graph.columns(controls, part.start, part.stop)
        if moves:
            mean = graph.constant(known.mean[part])
            offset = graph.minus(value, mean)
            length = graph.over(graph.length(offset), graph.constant(np.float64(max(float(largest), 1e-9))))
            kept = graph.over(_fading(graph, length, FADED), graph.at_least(length, 1.0))
            value = graph.plus(mean, graph.times(kept, offset))
        parts.append(value)
    found = graph.add("Concat", *parts, axis=-1)
    columns, turned = layout.pose_columns, 6 * len(layout.joints)
    pose = graph.chosen(found, columns, 1)
    anchors, distances = _nearest_points(graph, pose, known.poses.astype(np.float64), turned)
    offset = graph.minus(pose, anchors)
    apart = graph.at_least(_degrees(graph, graph.length(graph.columns(offset, 0, turned)), turned), 1e-9)
    inward = graph.at_most(graph.over(graph.constant(np.float64(regressor.safe_deg)), apart), 1.0)
    safe = graph.plus(anchors, graph.times(inward, offset))
    # back to where they stood among the controls
    order = np.arange(layout.size)
    order[columns] = layout.size + np.arange(len(columns))
    inside = graph.chosen(graph.add("Concat", found, safe, axis=-1), order, 1)
    fading = _fading(graph, graph.over(distances, graph.constant(np.float64(regressor.safe_deg))), FADED_POSES)
    trust = graph.times(_trust(graph, known.trust, distances), fading)
    answers = _answer(graph, regressor.regressor, inside)
    largest, std = graph.constant(limits.largest), graph.constant(limits.std)
    boxed = graph.add("Max", graph.add("Min", answers, largest), graph.constant(-limits.largest.astype(np.float64)))
    length = graph.at_least(graph.length(graph.over(boxed, std)), 1e-9)
    boxed = graph.times(boxed, graph.at_most(graph.over(graph.constant(np.float64(limits.length)), length), 1.0))
    resting = graph.constant(np.zeros_like(limits.std) if limits.resting is None else limits.resting)
    return graph.plus(resting, graph.times(trust, graph.minus(boxed, resting)))


def _nearest_points(graph: Graph, pose: Name, learned: np.ndarray, turned: int) -> tuple[Name, Name]:
    """A point amid the learned ones that are nearest, and the degrees to the very nearest, (frames, 1)."""
    if not len(learned) or not learned.shape[1]:
        nothing = graph.times(graph.summed(pose, -1), graph.constant(np.float64(0)))
        return pose, nothing
    squares = _squares(graph, graph.columns(pose, 0, turned), learned[:, :turned])
    apart = graph.add("Sqrt", graph.at_least(squares, 0.0))
    least = graph.add("ReduceMin", apart, graph.whole(-1), keepdims=1)
    reach = graph.at_least(graph.times(least, graph.constant(np.float64(NEAREST_SHARE))), 1e-6)
    weights = graph.add("Exp", graph.over(graph.minus(least, apart), reach))
    points = graph.over(graph.matrix(weights, graph.constant(learned)), graph.summed(weights, -1))
    return points, _degrees(graph, least, turned)


def _degrees(graph: Graph, length: Name, turned: int) -> Name:
    factor = np.degrees(1 / (np.sqrt(max(turned // 6, 1)) * NUMBERS_OF_A_RADIAN))
    return graph.times(length, graph.constant(np.float64(factor)))


def _fading(graph: Graph, times: Name, gone: float) -> Name:
    """1 up to 1, then smoothly down to 0: 1 - b^2 (3 - 2 b)."""
    one = graph.constant(np.float64(1))
    beyond = graph.over(graph.minus(times, one), graph.constant(np.float64(gone - 1)))
    beyond = graph.at_most(graph.at_least(beyond, 0.0), 1.0)
    rest = graph.minus(graph.constant(np.float64(3)), graph.times(beyond, graph.constant(np.float64(2))))
    return graph.minus(one, graph.times(graph.times(beyond, beyond), rest))


def _trust(graph: Graph, trust: Trust, degrees: Name) -> Name:
    """Linear between knots: what each stretch between two of them adds."""
    knots = trust.knots.astype(np.float64)
    total = graph.plus(graph.times(degrees, graph.constant(np.float64(0))), graph.constant(knots[0, 1]))
    for (start, high), (stop, low) in itertools.pairwise(knots.tolist()):
        if stop > start:
            gone = graph.at_most(graph.at_least(degrees, float(start)), float(stop))
            gone = graph.minus(gone, graph.constant(np.float64(start)))
            total = graph.plus(total, graph.times(gone, graph.constant(np.float64((low - high) / (stop - start)))))
        elif low != high:
            passed = graph.as_double(graph.add("GreaterOrEqual", degrees, graph.constant(np.float64(start))))
            total = graph.plus(total, graph.times(passed, graph.constant(np.float64(low - high))))
    return total


# --- garments with styles ----------------------------------------------------------------------------------------


def styled_graph(garment: StyledGarment, worn: WornGarment, numbers: np.ndarray) -> Graph:
    """Inputs `rotations` (frames, joints, 3, 3), of joints against their parents, and `transforms`
    (frames, joints, 4, 4), output `vertices` (frames, verts, 3), metres; all float64. One style on one person.

    Args:
        numbers: style and shape, from -1 to 1.
    Raises:
        InputError: the model is told poses as axes and angles.
    """
    if garment.pose.kind != "matrices":
        raise InputError("expected a model that is told poses as matrices, found one of axes and angles")
    weights, joints = garment.garment.skin_weights, len(garment.body.joint_names)
    assert weights is not None
    graph = Graph("styled_garment")
    rotations = graph.input("rotations", ("frames", joints, 3, 3))
    transforms = graph.input("transforms", ("frames", joints, 4, 4))
    chosen = graph.reshaped(graph.chosen(rotations, garment.pose.joints, 1), 0, -1)
    pose = graph.over(graph.minus(chosen, graph.constant(garment.pose.mean)), graph.constant(garment.pose.scale))
    said = _displacements(graph, garment, worn, pose, np.asarray(numbers, np.float64))
    rest = worn.in_a_pose if garment.over_drape else worn.under
    unposed = graph.plus(graph.constant(rest.reshape(-1)), said)
    vertices = _skinned(graph, graph.reshaped(unposed, 0, len(rest), 3), weights, transforms)
    graph.output("vertices", vertices, ("frames", len(rest), 3))
    return graph


def _displacements(graph: Graph, garment: StyledGarment, worn: WornGarment, pose: Name, numbers: np.ndarray) -> Name:
    """(frames, 3 verts): what `Predictor.displacements` says."""
    predictor = garment.predictor
    if isinstance(predictor, Ensemble):
        said = []
        if predictor.networks:
            asked = _joined(graph, pose, numbers.astype(np.float32))
            answers = [perceptron(graph, network, asked) for network in predictor.networks]
            said.append(graph.times(graph.add("Sum", *answers), graph.constant(np.float64(1 / len(answers)))))
        if predictor.kernels is not None:
            asked = _joined(graph, pose, (predictor.style_weight * numbers).astype(np.float32))
            said.append(_by_ridge(graph, predictor.kernels, asked))
        mean = graph.times(graph.add("Sum", *said), graph.constant(np.float64(1 / len(said))))
        return _decoded(graph, predictor.head, mean)
    asked = _joined(graph, pose, numbers.astype(np.float32))
    total = _decoded(graph, predictor.low_head, perceptron(graph, predictor.low, asked))
    for weight, network in zip(predictor.weights(worn.canonical), predictor.high, strict=True):
        if weight >= SPEAKS:
            high = _decoded(graph, predictor.high_head, perceptron(graph, network, pose))
            total = graph.plus(total, graph.times(high, graph.constant(np.float64(weight))))
    return total


def _joined(graph: Graph, pose: Name, numbers: np.ndarray) -> Name:
    frames = graph.add("Shape", pose, start=0, end=1)
    shape = graph.add("Concat", frames, graph.whole(len(numbers)), axis=0)
    return graph.add("Concat", pose, graph.add("Expand", graph.constant(numbers[None]), shape), axis=-1)


def _by_ridge(graph: Graph, kernels: KernelRidge, asked: Name) -> Name:
    """`KernelRidge.predict`: a Gaussian kernel, and a linear one with an intercept."""
    ours = graph.over(asked, graph.constant(np.float64(kernels.length)))
    alike = _gaussian(graph, ours, kernels.points)
    if kernels.line:
        line = graph.plus(graph.matrix(ours, graph.constant(kernels.points.T)), graph.constant(np.float64(1)))
        alike = graph.plus(alike, graph.times(line, graph.constant(np.float64(kernels.line))))
    return graph.matrix(alike, graph.constant(kernels.answers))


def _decoded(graph: Graph, head: Head, outputs: Name) -> Name:
    """(frames, 3 verts), metres."""
    flat = graph.times(outputs, graph.constant(np.float64(head.scale)))
    flat = flat if head.directions is None else graph.matrix(flat, graph.constant(head.directions))
    return graph.plus(flat, graph.constant(head.mean))
