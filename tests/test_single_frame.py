"""One frame by itself: the fit of the search for many frames, to rounding."""

import numpy as np
import pytest
import scenes
from frame_parts import assert_calibrated
from numpy.testing import assert_allclose

from isa_nrsfm._frames.models import FrameMap, PosteriorFrames
from isa_nrsfm._tables.blocks import block_slices

CAMERAS = ["affine", "weak_perspective", "orthographic"]
NOISE = 0.02


def model_and_tracks(camera, seed=0, *, extent=(1.0, 1.0, 0.5), n_components=3):
    scene = scenes.random_scene(
        seed, 40, 12, n_components, camera=camera, noise=NOISE, extent=extent
    )
    starts, gauge = np.zeros((0, n_components)), FrameMap.identity(n_components)
    model = PosteriorFrames(scene.shapes, NOISE**2, starts, "linear", gauge, camera)
    return model, scene.tracks


def assert_same(alone, together, atol=1e-9):
    for got, expected in zip(alone[:-1], together[:-1], strict=True):
        scale = np.abs(expected).max(initial=0.0) if np.isfinite(expected).all() else 1
        assert_allclose(got, expected, rtol=1e-6, atol=atol * scale)
    assert alone.converged == together.converged


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("extent", [(1.0, 1.0, 0.5), (1.0, 1.0, 0.02), (3.0, 0.1, 1.0)])
def test_is_the_fit_of_the_frame_among_others(camera, extent):
    model, tracks = model_and_tracks(camera, extent=extent)
    rows = np.ascontiguousarray(tracks.transpose(0, 2, 1))
    together = model.posterior(rows)
    n_alone = 0
    for i in range(len(tracks)):
        assert_same(model.posterior(rows[[i]]), together.take([i]))
        n_alone += model._alone(rows[i]) is not None
    # Frames whose reversed camera is the better one are left to the other search.
    assert n_alone >= (0.4 if extent[2] == 0.02 else 0.7) * len(tracks)


@pytest.mark.parametrize("camera", CAMERAS)
def test_is_a_minimum_of_the_documented_objective(camera):
    model, tracks = model_and_tracks(camera, 1)
    fit = model._alone(tracks[0].T)
    image = scenes.images(model.shapes, fit.motion, fit.translation, fit.alpha)
    square = np.sum((tracks[:1] - image) ** 2) + NOISE**2 * np.sum(fit.alpha**2)
    assert_allclose(fit.objective, square, rtol=1e-9)
    if camera != "affine":
        assert_calibrated(fit.motion, camera)


@pytest.mark.parametrize("camera", CAMERAS)
def test_unusual_frames_are_those_of_the_search_for_many(camera):
    model, tracks = model_and_tracks(camera)
    tracks = tracks[:5].copy()
    tracks[0, 3] = np.nan
    tracks[1] += np.random.default_rng(0).normal(size=(12, 2))  # badly fitted
    tracks[2] = 1.0
    tracks[3] = np.nan
    tracks[4] *= 1e100
    rows = np.ascontiguousarray(tracks.transpose(0, 2, 1))
    together = model.posterior(rows)
    for i in range(5):
        assert_same(model.posterior(rows[[i]]), together.take([i]))
    assert [model._alone(frame) is None for frame in rows[[0, 1, 3]]] == [True] * 3


@pytest.mark.parametrize("camera", CAMERAS)
def test_flat_shapes(camera):
    model, tracks = model_and_tracks(camera, extent=(1.0, 1.0, 0.0))
    rows = np.ascontiguousarray(tracks.transpose(0, 2, 1))
    together = model.posterior(rows)
    for i in range(5):
        assert_same(model.posterior(rows[[i]]), together.take([i]))


@pytest.mark.parametrize("camera", CAMERAS)
def test_single_precision(camera):
    model, tracks = model_and_tracks(camera)
    tracks = tracks.astype(np.float32)
    rows = np.ascontiguousarray(tracks.transpose(0, 2, 1))
    together = model.posterior(rows)
    for i in range(3):
        assert_same(model.posterior(rows[[i]]), together.take([i]))


def test_covariances_can_be_left_out():
    model, tracks = model_and_tracks("weak_perspective")
    with_them, without = (
        model.posterior(tracks[:1].transpose(0, 2, 1), which) for which in (True, False)
    )
    assert_same(without._replace(covariance=with_them.covariance), with_them)


@pytest.mark.parametrize("length", [1, 2, 5, 11, 12, 40])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 11, 12, 13])
def test_no_block_of_several_has_one_frame(n, length):
    slices = block_slices(n, length)
    assert [i for part in slices for i in range(n)[part]] == list(range(n))
    lengths = [part.stop - part.start for part in slices]
    assert all(1 < each <= length + 1 for each in lengths[-1:] if n > 1)
    assert lengths[:-1] == [length] * (len(slices) - 1)
