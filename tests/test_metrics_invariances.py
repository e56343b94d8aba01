"""What the errors of 3D shapes ignore, and what they do not."""

from functools import partial

import numpy as np
import pytest
from scenes import random_rotation

from isa_nrsfm.metrics import affine_shape_error, mean_shape_error_3d

MEASURES = {
    "affine": affine_shape_error,
    "sequence": mean_shape_error_3d,
    "frame": partial(mean_shape_error_3d, convention="frame"),
    "scaled sequence": partial(mean_shape_error_3d, scale=True),
    "frame, no scale": partial(mean_shape_error_3d, convention="frame", scale=False),
    "camera": partial(mean_shape_error_3d, convention="camera"),
    "scaled camera": partial(mean_shape_error_3d, convention="camera", scale=True),
}
ALL = set(MEASURES)
N, J = 6, 15
RNG = np.random.default_rng(0)
TRUTH = RNG.standard_normal((N, J, 3)) + 4.0
SHAPES = TRUTH + 0.3 * RNG.standard_normal((N, J, 3))
FRAMES, POINTS = RNG.permutation(N), RNG.permutation(J)
SCALES = RNG.uniform(0.2, 3.0, (N, 1, 1))
SIGNS = np.resize([1.0, -1.0], (N, 1, 1))
TURNS = np.stack([random_rotation(i) for i in range(N)])
MIRROR = np.diag([1.0, 1.0, -1.0])
AFFINITY = np.array([[1.0, 0.5, 0.2], [0.0, 2.0, -0.3], [0.3, 0.0, 0.4]])

# What is done to truth and shapes, and which measures do not change by it.
CHANGES = {
    "places": (lambda S, X: (S + TURNS[:, :1], X + 9 * TURNS[:, 1:2]), ALL),
    "order": (lambda S, X: (S[FRAMES][:, POINTS], X[FRAMES][:, POINTS]), ALL),
    "common rotation": (
        lambda S, X: (S, X @ TURNS[1]),
        ALL - {"camera", "scaled camera"},
    ),
    "common mirror image": (lambda S, X: (S, X @ MIRROR), ALL),
    "small unit": (lambda S, X: (1e-80 * S, 1e-80 * X), ALL),
    "large unit": (lambda S, X: (1e75 * S, 1e75 * X), ALL),
    "common scale": (
        lambda S, X: (S, 3 * X),
        {"affine", "frame", "scaled sequence", "scaled camera"},
    ),
    "scales of frames": (lambda S, X: (S, SCALES * X), {"affine", "frame"}),
    "points reflected in frames": (
        lambda S, X: (S, SIGNS * X),
        {"affine", "frame", "frame, no scale"},
    ),
    "rotations of frames": (lambda S, X: (S, X @ TURNS), {"frame", "frame, no scale"}),
    "affinity": (lambda S, X: (S, X @ AFFINITY), {"affine"}),
    "singular affinity": (lambda S, X: (S, X @ np.diag([1, 1e3, 1e-3])), {"affine"}),
}


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("change", CHANGES)
def test_invariance(measure, change):
    changed, invariant = CHANGES[change]
    error = MEASURES[measure]
    expected, found = error(TRUTH, SHAPES), error(*changed(TRUTH, SHAPES))
    assert 0.01 < expected < 1
    assert (found == pytest.approx(expected, rel=1e-7)) == (measure in invariant)
    # Equal shapes have no error, and changed ones none if the measure ignores it.
    assert error(TRUTH, TRUTH) < 1e-12
    assert (error(*changed(TRUTH, TRUTH)) < 1e-11) == (measure in invariant)
