"""Landmark columns recognised by their names."""

import numpy as np
from landmark_files import openface_names
from refusals import refusals_of, warned

from isa_nrsfm.io._landmark_columns import (  # noqa: F401  in refusals.txt
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


PARTS = ("nose", "chin", "left eye", "brow_1", "brow_2", "mouth-l", "mouth-r")


def pattern_of_names(template):
    """Return the pattern of named points, which are found in the order of the table."""
    names = ["id", *named(template, points=PARTS)]
    found = find_landmark_columns(names)
    assert (found.interleaved, found.points) == (names[1:], PARTS)
    return found.pattern


def test_patterns_that_match_a_part_of_a_set_say_so():
    names = named("{a}_{p}", points=range(20))
    message = "leave out 20 .* first is 'x_0'"
    found = warned(message, find_landmark_columns, names, "x_1#,y_1#")
    assert found.points == tuple(map(str, range(10, 20)))


SIDES = named("right_{p}_{a}") + named("left_{p}_{a}")
EARS = [*named("lm_{p}_{a}"), "ear_x", "ear_y"]
FEW = named("{p}_{a}", points=["hat", *"abcde"])
PIXELS = [f"{axis}{j}px" for j in (2, 10, 1) for axis in "vu"]
OPENFACE = [f" {name}" for name in openface_names()]

test_refusals = refusals_of("landmark_names", globals())
