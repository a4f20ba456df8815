"""What the comparison concludes follows from its numbers."""

from dataclasses import replace

import pytest

from capture4d.app.compare.measures import Row, conclusion


def row(name: str, vertex_mm: float | None = None, normal_deg: float | None = None, **more: object) -> Row:
    return replace(Row(name, vertex_mm, normal_deg, None, None, 1.0, 1.0, learned=False), **more)


BARE, MADE = row("registration", None, 10.0), row("network", None, 5.0)
NEAR, FAR = row("regression, linear", 12.0), row("offset images", 20.0)


def test_maps_are_judged_by_the_registration_without_them() -> None:
    said = conclusion([BARE, MADE], against_truth=True)
    assert said == (
        "The network's maps are worth having: they are 5.0 deg off the scans' normals where the bare registration "
        "is 10.0."
    )
    kept = [replace(BARE, wrinkle_energy_kept=0.33), replace(MADE, wrinkle_energy_kept=0.87)]
    assert "10.0, and 0.87 of their wrinkle energy where it has 0.33." in conclusion(kept, against_truth=True)
    for degrees in (9.7, 10.0, 14.0):
        worse = conclusion([BARE, replace(MADE, normal_deg=degrees)], against_truth=True)
        assert worse.startswith("The network's maps are not worth having")
    assert conclusion([replace(BARE, normal_deg=None), MADE], against_truth=True) == ""


@pytest.mark.parametrize(("against_truth", "goal"), [(True, "the true positions"), (False, "the registration")])
def test_the_nearest_surface_from_poses_alone_is_named(against_truth: bool, goal: str) -> None:
    for rows in ([NEAR, FAR], [FAR, NEAR]):
        assert conclusion(rows, against_truth=against_truth) == (
            f"From poses alone, take regression, linear: 12.0 mm from {goal}; farther are offset images 20.0."
        )
    said = conclusion([NEAR, replace(FAR, vertex_mm=12.3)], against_truth=against_truth)
    assert said.endswith("; offset images is as good.")


def test_what_knows_the_scans_does_not_compete_with_what_does_not() -> None:
    assert "take offset images" in conclusion([row("blendshapes", 1.0), FAR], against_truth=True)


def test_what_learned_from_these_frames_proves_nothing() -> None:
    seen = replace(NEAR, learned=True)
    said = conclusion([seen, FAR], against_truth=True)
    assert "take offset images: 20.0 mm" in said
    assert "12.0" not in said
    assert said.endswith("rows with an asterisk are left out of this.")
    assert "nothing follows about other motions" in conclusion([seen], against_truth=True)
