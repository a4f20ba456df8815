"""What has changed is said in words."""

from pathlib import Path

from capture4d.runs.changes import (
    StageChanges,
    description_changes,
    frame_changes,
    input_changes,
    setting_changes,
)


def test_settings_are_called_by_their_own_name_unless_two_are_named_alike():
    before = {"sequence": {"relax": 0.4, "segment": 240}, "coarse": {"gate": 1}, "dense": {"gate": 1, "only": "a"}}
    now = {"sequence": {"relax": 0.5, "segment": 240}, "coarse": {"gate": 2}, "dense": {"gate": 3, "only": "b"}}
    assert setting_changes(now, before) == [
        "relax 0.4 to 0.5",
        "coarse.gate 1 to 2",
        "dense.gate 1 to 3",
        "only a to b",
    ]
    assert setting_changes(now, now) == []
    assert setting_changes({"new": None, "sizes": [1, 2]}, {"old": 3, "sizes": [1]}) == [
        "sizes [1] to [1, 2]",
        "old 3 to none",
    ]


def test_a_border_that_is_renamed_is_not_one_that_came_and_one_that_went():
    borders = {"boundary_colours": {"neck": "#aaaaaa", "hem": "#bbbbbb"}, "fps": 30.0}
    assert description_changes(borders, borders) == []
    renamed = {"boundary_colours": {"neck": "#aaaaaa", "waist": "#bbbbbb"}, "fps": 60.0}
    assert description_changes(renamed, borders) == ["border hem renamed to waist", "fps 30.0 to 60.0"]
    other = {"boundary_colours": {"neck": "#cccccc", "cuff": "#dddddd"}, "fps": 30.0}
    assert description_changes(other, borders) == [
        "border hem removed",
        "border cuff added",
        "colour of border neck #aaaaaa to #cccccc",
    ]
    assert description_changes({"garment_colour": None}, {"garment_colour": "#2f62c9"}) == [
        "garment colour #2f62c9 to none"
    ]


def test_frames_and_inputs_come_and_go():
    assert frame_changes((1, 2, 4, 5, 6), (1, 2, 3)) == ["3 frames added (4-6)", "frame 3 removed"]
    assert input_changes({"template": "b", "body": "x"}, {"template": "a", "motion": "y"}) == [
        "template changed",
        "body added",
        "motion removed",
    ]


def test_what_stages_before_do_again_may_follow():
    first = StageChanges("extract", Path("g"), "outdated", pending=(3,))
    last = StageChanges("register", Path("r"), "current", frames=5)
    after = last.after([first])
    assert (after.state, after.pending, after.following) == ("outdated", (), (3,))
    assert last.after([StageChanges("extract", Path("g"), "current")]) == last
