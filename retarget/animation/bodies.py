"""The learned garment on somebody else: its mean moves with the body under it.

References: DeepWrinkles (ECCV 2018), section 3.5, Eq. 5. As printed the mean of person i is M_bar + o'_i, o'_i being
the person's offset from the average body; that counts the captured person's shape twice unless they were average.
Corrected: M_bar + o'_i - o'_captured, restricted to the garment.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Float, Float64

from capture4d.body.binding import embedded_offset
from capture4d.body.skinning import ShapedBody, with_shape
from capture4d.errors import InputError
from capture4d.types import BlendshapeModel, Body, PoseSequence

__all__ = ["captured_person", "person_of_shape", "require_motion", "retargeted_mean"]


def captured_person(model: BlendshapeModel, body: Body) -> ShapedBody:
    """The person the garment was learned on.

    Raises:
        InputError: the model does not say who that was, or the body has another skeleton.
    """
    _require_skeleton(model, body)
    if model.garment.body_shape is None:
        raise InputError("model: expected the shape of the captured person in its garment, found none")
    return with_shape(body, model.garment.body_shape)


def person_of_shape(
    model: BlendshapeModel, body: Body, beta: Sequence[float] | Float[np.ndarray, " betas"]
) -> ShapedBody:
    """Somebody to put the garment on.

    Args:
        beta: shape coefficients; those that are left out at the end are 0.
    Raises:
        InputError: the body has other joints than the model, or the coefficients are too many or not finite.
    """
    _require_skeleton(model, body)
    shape, given = np.zeros(len(body.shape_directions), np.float32), np.asarray(beta, np.float32)
    if not np.isfinite(given).all():
        raise InputError("beta: expected finite numbers, found NaN or inf")
    if len(given) > len(shape):
        raise InputError(f"beta: expected at most {len(shape)} coefficients, found {len(given)}")
    shape[: len(given)] = given
    return with_shape(body, shape)


def require_motion(model: BlendshapeModel, poses: PoseSequence) -> None:
    """
    Raises:
        InputError: there are no poses, not in the order of their frames, or of other joints than the model.
    """
    if not len(poses.frame_ids) or (np.diff(poses.frame_ids) <= 0).any():
        disorder = " in disorder" if len(poses.frame_ids) else ""
        raise InputError(f"expected frames with ascending numbers, found {len(poses.frame_ids)} frames{disorder}")
    if poses.joint_names != model.joint_names:
        raise InputError(
            f"expected the {len(model.joint_names)} joints of the model, found {len(poses.joint_names)} "
            f"({', '.join(poses.joint_names[:4])}, ...)"
        )


def _require_skeleton(model: BlendshapeModel, body: Body) -> None:
    """
    Raises:
        InputError: the body has other joints than the model.
    """
    if body.joint_names != model.joint_names:
        wanted, found = (", ".join(names[:4]) for names in (model.joint_names, body.joint_names))
        raise InputError(
            f"body: expected the {len(model.joint_names)} joints of the model ({wanted}, ...), "
            f"found {len(body.joint_names)} ({found}, ...)"
        )


def retargeted_mean(
    model: BlendshapeModel,
    captured: ShapedBody,
    person: ShapedBody,
    *,
    formula: Literal["corrected", "printed", "captured"] = "corrected",
) -> Float64[np.ndarray, "verts 3"]:
    """The garment's mean in the rest pose of another person, metres.

    Args:
        formula: Eq. 5 corrected, as printed, or the mean as it was captured.
    Raises:
        InputError: the two bodies are not made of the same faces.
    """
    mean = model.mean.astype(np.float64)
    if not np.array_equal(captured.body.template.faces, person.body.template.faces):
        raise InputError(
            f"body: expected the {len(captured.body.template.faces)} faces of the body the garment was learned on, "
            f"found {len(person.body.template.faces)} others"
        )
    match formula:
        case "captured":
            return mean
        case "corrected":
            change = person.vertices - captured.vertices
        case "printed":
            change = person.vertices - captured.body.template.vertices
        case other:
            assert_never(other)
    return mean + embedded_offset(model.garment, captured.body, change)
