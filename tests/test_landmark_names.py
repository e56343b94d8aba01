"""Landmark columns recognised by their names."""

import numpy as np
import pytest
from landmark_files import openface_names
from refusals import refusals_of, refused, warned

from isa_nrsfm.io._landmark_columns import (
    MIN_POINTS,
    find_landmark_columns,
    landmark_sets,
)
from isa_nrsfm.skeletons._column_names import (  # noqa: F401  in refusals.txt
    names_layout,
    parse_coordinate,
    point_names,
)

N_POINTS = 9


def named(template, axes="xy", points=range(N_POINTS)):
    """Return interleaved names from a template with {a} and {p}."""
    return [template.format(a=axis, p=point) for point in points for axis in axes]


def pattern_of(template):
    """Return the pattern of numbered points, which are found in numeric order."""
    names = named(template, points=range(12))
    shuffled = ["id", *np.random.default_rng(0).permutation(names), "confidence"]
    found = find_landmark_columns(shuffled)
    assert found.interleaved == names
    assert find_landmark_columns(shuffled, columns=found.pattern) == found
    return found.pattern


@pytest.mark.parametrize(
    ("template", "pattern"),
    [("{p}_{a}", "*_x,*_y"), ("{p}.{a}", "*.x,*.y"), ("{a}_{p}", "x_*,y_*")],
)
def test_named_points_keep_the_order_of_the_table(template, pattern):
    points = ["nose", "chin", "left eye", "brow_1", "brow_2", "mouth-l", "mouth-r"]
    names = ["id", *named(template, points=points)]
    found = find_landmark_columns(names)
    assert found.pattern == pattern
    assert found.interleaved == names[1:]
    assert found.points == tuple(points)


def test_gaps_in_the_numbers_are_not_refused():
    names = named("{a}{p}", points=[3, 4, 5, 7, 8, 9, 12])
    found = find_landmark_columns(names)
    assert found.points == ("3", "4", "5", "7", "8", "9", "12")


def test_case_and_prefix_separate_sets():
    sets = landmark_sets(openface_names())
    assert len(openface_names()) == 714
    assert sets == {
        "gaze_#_x,gaze_#_y": 2,
        "*_x,*_y": 3,
        "eye_lmk_x_#,eye_lmk_y_#": 56,
        "eye_lmk_X_#,eye_lmk_Y_#": 56,
        "x_#,y_#": 68,
        "X_#,Y_#": 68,
    }


def test_several_sets_are_refused_with_the_ways_to_choose():
    names = [f" {name}" for name in openface_names()]
    message = str(refused("more than one set", find_landmark_columns, names))
    assert "'x_#,y_#' (68 points: x_0 to x_67)" in message
    assert "'eye_lmk_x_#,eye_lmk_y_#' (56 points: " in message
    assert "'X_#,Y_#' (68 points, with a z each: X_0 to X_67)" in message
    assert "gaze" not in message
    assert "Choose with columns, such as" in message
    found = find_landmark_columns(names, columns="x_#,y_#")
    assert found.x == tuple(f" x_{j}" for j in range(68))
    assert found.z == ()
    upper = find_landmark_columns(names, columns="X_#,Y_#")
    assert upper.x[0] == " X_0"
    assert upper.z[67] == " Z_67"


def test_a_numbered_set_with_another_point_of_that_form_is_ambiguous():
    names = [*named("lm_{p}_{a}"), "ear_x", "ear_y"]
    refused(r"'lm_#_x,lm_#_y' \(9 .*'\*_x,\*_y' \(10 ", find_landmark_columns, names)
    assert len(find_landmark_columns(names, columns="lm_#_x,lm_#_y").x) == N_POINTS
    assert len(find_landmark_columns(names, columns="*_x,*_y").x) == N_POINTS + 1


def test_several_pairs_of_patterns_follow_one_another():
    names = named("right_{p}_{a}") + named("left_{p}_{a}")
    patterns = ["left_#_x", "left_#_y", "right_#_x", "right_#_y"]
    found = find_landmark_columns(names, columns=patterns)
    assert found.points[N_POINTS - 1 : N_POINTS + 1] == ("left_8", "right_0")
    assert find_landmark_columns(names, columns=", ".join(patterns)) == found


def test_patterns_reach_names_of_any_form():
    names = [f"{axis}{j}px" for j in (2, 10, 1) for axis in "vu"]
    found = find_landmark_columns(names, columns="u#px,v#px")
    assert found.interleaved == ["u1px", "v1px", "u2px", "v2px", "u10px", "v10px"]
    assert found.points == ("u1px", "u2px", "u10px")
    single = find_landmark_columns(["a", "b", "c"], columns="c,a")
    assert single.interleaved == ["c", "a"]


def test_small_sets_do_not_compete_and_do_not_suffice():
    small = named("{p}_{a}", points=["hat", *"abcde"])
    assert len(small) == 2 * (MIN_POINTS - 1)
    assert find_landmark_columns(small + named("{a}{p}")).pattern == "x#,y#"
    refused(r"fewer than 7 points: '\*_x,\*_y' \(6\)", find_landmark_columns, small)
    assert len(find_landmark_columns(small, columns="*_x,*_y").x) == MIN_POINTS - 1


def test_patterns_that_match_a_part_of_a_set_say_so():
    names = named("{a}_{p}", points=range(20))
    message = "leave out 20 .* first is 'x_0'"
    found = warned(message, find_landmark_columns, names, "x_1#,y_1#")
    assert found.points == tuple(map(str, range(10, 20)))


def test_columns_that_are_named_one_by_one_are_a_choice():
    names = named("{a}_{p}")
    chosen = named("{a}_{p}", points=range(1, 8))
    assert find_landmark_columns(names, columns=chosen).interleaved == chosen


test_refusals = refusals_of("landmark_names", globals())
