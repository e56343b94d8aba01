"""The symmetric metric of space that makes cameras weak-perspective ones."""

import numpy as np
import pytest
from cameras import affinity, lorentz_cameras, rotations, weak_perspective
from numpy.testing import assert_allclose
from refusals import refused

from isa_nrsfm.calibration._metric import LARGEST_STRETCH, metric_quadric


def products(G, motion):
    """Return the products of the rows of cameras, each divided by its norm."""
    unit = motion / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
    return unit @ G @ unit.mT


@pytest.mark.parametrize("n_frames", [3, 30])
def test_of_weak_perspective_cameras_is_the_metric(n_frames, rng):
    A = affinity(rng)
    G = metric_quadric(weak_perspective(rng, n_frames) @ np.linalg.inv(A))
    expected = A @ A.T
    assert_allclose(G / np.trace(G), expected / np.trace(expected), atol=1e-9)


def test_is_the_least_squares_solution(rng):
    motion = weak_perspective(rng) + 0.3 * rng.standard_normal((30, 2, 3))

    def cost(G):
        (xx, xy), (_, yy) = np.moveaxis(products(G, motion), 0, -1)
        return np.sum((xx - yy) ** 2 + 4 * xy**2) / np.mean(xx + yy) ** 2

    G = metric_quadric(motion)
    nothing = [np.full((1, 2, 3), value) for value in (np.nan, 0.0)]
    assert_allclose(metric_quadric(np.concatenate([motion, *nothing])), G)
    assert np.mean(np.trace(products(G, motion), axis1=1, axis2=2)) == pytest.approx(1)
    steps = 1e-2 * np.linalg.norm(G) * rng.standard_normal((50, 3, 3))
    assert all(cost(G + step + step.T) > cost(G) > 1e-3 for step in steps)


def test_little_depth_is_not_taken_for_none(rng):
    # Faces that hardly turn: a solution that keeps the norm of G constant, not the
    # size of the cameras, would let depth vanish.
    cameras = rotations(rng, 2000, spread=0.1)[:, :2]
    noise = 0.02 * rng.standard_normal(cameras.shape) * [1, 1, 0.1]
    eigenvalues = np.linalg.eigvalsh(metric_quadric(cameras + noise))
    assert_allclose(eigenvalues, eigenvalues.mean(), rtol=0.3)


def test_cameras_that_determine_no_metric_have_none(rng):
    flat = rng.standard_normal((10, 2, 3)) * [1.0, 1.0, 0.0]
    for motion in (
        np.repeat(rng.standard_normal((1, 2, 3)), 10, axis=0),
        weak_perspective(rng, 2),
        flat @ affinity(rng),
        lorentz_cameras(rng),  # indefinite
        weak_perspective(rng) @ np.diag([1, 1, 2 * LARGEST_STRETCH]),
    ):
        assert metric_quadric(motion) is None
    motion = weak_perspective(rng) @ np.diag([1, 1, 0.9 * LARGEST_STRETCH])
    assert metric_quadric(motion) is not None
    refused("none among the 2 cameras", metric_quadric, np.zeros((2, 2, 3)))
