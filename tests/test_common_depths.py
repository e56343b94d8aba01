"""Depths that are common to overlapping groups of points."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from isa_nrsfm._joint.common_depths import (
    _principal,
    _turns,
    aligning_rotations,
    common_coordinates,
)

FLOOR = 1e-5


def scene(n_frames=60, seed=0):
    """Return coordinates (I, 3, 16) of two jointed bodies of rank one, and groups.

    Each body has ten points, four of them common, and turns by itself about these.
    """
    rng = np.random.default_rng(seed)
    views = Rotation.from_rotvec(0.6 * rng.standard_normal((n_frames, 3))).as_matrix()
    Y = np.zeros((n_frames, 3, 16))
    joint = np.zeros((3, 4))
    joint[0] = [-0.3, -0.1, 0.1, 0.3]  # on the axis of the joint
    for part in (slice(4, 10), slice(10, 16)):
        shape, change = rng.standard_normal((2, 3, 6)) * [[[1.0]], [[0.2]]]
        alpha = rng.standard_normal(n_frames)
        bend = 0.6 * rng.standard_normal(n_frames)
        turns = Rotation.from_rotvec(np.outer(bend, [1.0, 0.0, 0.0])).as_matrix()
        Y[:, :, part] = turns @ (shape + alpha[:, None, None] * change)
    Y[:, :, :4] = joint
    Y = views @ Y
    frames = np.arange(n_frames)
    groups = [(frames, np.arange(10)), (frames, np.r_[0:4, 10:16])]
    return Y - Y.mean(axis=2, keepdims=True), groups


def perturbed(Y, size=0.1):
    """Return coordinates with errors of the depths."""
    off = size * np.random.default_rng(1).standard_normal(Y[:, 2].shape)
    first = Y.copy()
    first[:, 2] += off - off.mean(axis=1, keepdims=True)
    return first


def error(found, Y):
    """Return the relative error of the depths."""
    z = found[:, 2] - found[:, 2].mean(axis=1, keepdims=True)
    return np.linalg.norm(z - Y[:, 2]) / np.linalg.norm(Y[:, 2])


def test_depths_become_truer_and_true_ones_stay():
    Y, groups = scene()
    first = perturbed(Y)
    found = common_coordinates(Y[:, :2], first, groups, FLOOR, FLOOR)
    assert error(found, Y) < 0.5 * error(first, Y)
    assert_array_equal(found[:, :2], Y[:, :2])
    found = common_coordinates(Y[:, :2], Y, groups, FLOOR, FLOOR)
    assert error(found, Y) < 2 * np.sqrt(FLOOR)


def test_missing_points_are_filled_in():
    Y, groups = scene()
    hidden = np.random.default_rng(2).random(Y[:, 0].shape) < 0.2
    images = np.where(hidden[:, None], np.nan, Y[:, :2])
    first = perturbed(Y)
    first[:, :2] += 0.1 * hidden[:, None]
    found = common_coordinates(images, first, groups, FLOOR, FLOOR)
    seen = np.broadcast_to(~hidden[:, None], images.shape)
    assert_array_equal(found[:, :2][seen], Y[:, :2][seen])
    off = np.sqrt(np.mean((found[:, :2] - Y[:, :2])[~seen] ** 2))
    assert off < 0.05
    assert error(found, Y) < 0.5 * error(first, Y)


def test_order_of_groups_and_frames_does_not_matter():
    Y, groups = scene()
    first = perturbed(Y)
    found = common_coordinates(Y[:, :2], first, groups, FLOOR, FLOOR)
    order = np.random.default_rng(3).permutation(len(Y))
    again = common_coordinates(Y[order, :2], first[order], groups[::-1], FLOOR, FLOOR)
    assert_allclose(again, found[order], atol=1e-6)


def test_points_and_frames_of_no_group_stay():
    Y, (group, _) = scene()
    first = perturbed(Y)
    some = group[0][:-5], group[1]
    found = common_coordinates(Y[:, :2], first, [some], FLOOR, FLOOR)
    assert_allclose(found[:, :, 10:], first[:, :, 10:], atol=1e-12)
    assert_allclose(found[-5:], first[-5:], atol=1e-12)
    assert np.abs(found - first)[:-5, 2, :10].max() > 0.01


def test_mean_depths_of_frames_stay():
    Y, groups = scene()
    first = perturbed(Y) + np.arange(len(Y))[:, None, None]
    found = common_coordinates(first[:, :2], first, groups, FLOOR, FLOOR)
    assert_allclose(found[:, 2].mean(axis=1), first[:, 2].mean(axis=1), atol=1e-9)


@pytest.mark.parametrize("s2", [1e-3, 0.05])
def test_precision_is_that_of_probabilistic_components(s2, rng):
    """It is ``(B B^T + s2 I)^-1`` for ``B = U (v - s2)^.5``, for centred shapes."""
    B = rng.standard_normal((12, 2))
    shapes = (B @ rng.standard_normal((2, 500))).reshape(4, 3, 500)
    shapes += 0.1 * rng.standard_normal(shapes.shape)
    shapes -= shapes.mean(axis=0)
    found, slope = _principal(shapes, s2)
    values, vectors = np.linalg.eigh(np.cov(shapes.reshape(12, -1), bias=True))
    kept = values > s2
    B = vectors[:, kept] * np.sqrt(values[kept] - s2)
    centring = np.kron(np.eye(4) - 0.25, np.eye(3))
    expected = np.linalg.inv(B @ B.T + s2 * np.eye(12)) @ centring
    assert_allclose(found, expected, atol=1e-9 / s2)
    off = (shapes.mean(axis=2, keepdims=True) - shapes).reshape(12, -1)
    assert_allclose(slope.reshape(12, -1), expected @ off, atol=1e-9 / s2)


def test_turns_are_gauss_newton_steps_with_the_gaussian_held(rng):
    """They solve the normal equations of shapes that are turned, in each frame."""
    shapes = rng.standard_normal((5, 3, 1)) + 0.1 * rng.standard_normal((5, 3, 40))
    shapes -= shapes.mean(axis=0)
    precision, slope, *_, w = _turns(shapes, 1e-3)
    for i in (0, 17):
        S, step = shapes[:, :, i], 1e-6
        D = [
            (S @ Rotation.from_rotvec(step * axis).as_matrix() - S).ravel() / step
            for axis in np.eye(3)
        ]
        D = np.array(D).T
        expected = np.linalg.solve(D.T @ precision @ D, D.T @ slope[:, :, i].ravel())
        assert_allclose(w[:, i], expected, rtol=1e-4, atol=1e-6)


def test_points_on_a_line_do_not_turn_about_it():
    line = np.linspace(-1, 1, 5)[:, None, None] * np.array([0.0, 0.0, 1.0])[:, None]
    *_, w = _turns(line * np.array([1.0, 1.1, 0.9]), 1e-3)
    assert_allclose(w, 0.0, atol=1e-12)


def test_aligning_rotations_leave_the_deformation(rng):
    """Shapes of rank one that were turned have rank one again."""
    base, basis = rng.standard_normal((2, 3, 6))
    S = base + 0.3 * rng.standard_normal((50, 1, 1)) * basis
    S -= S.mean(axis=2, keepdims=True)
    S = Rotation.from_rotvec(0.1 * rng.standard_normal((50, 3))).as_matrix() @ S
    R = aligning_rotations(S, 1e-4)
    assert_allclose(
        R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12
    )
    second = [
        np.linalg.svd((each - each.mean(axis=0)).reshape(50, -1))[1][1]
        for each in (S, R.transpose(0, 2, 1) @ S)
    ]
    assert second[1] < 0.05 * second[0]
