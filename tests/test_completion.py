"""Completion of tracks by a low-rank model."""

import numpy as np
import pytest
from layers import slow_after
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from isa_nrsfm._prepare.completion import (
    completion_model,
    filled_in,
)
from isa_nrsfm._tables.tracks import centred_frames
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks


def hide(tracks, seen):
    """Return tracks with NaN where points are not seen."""
    return np.where(seen[..., None], tracks, np.nan)


def random_mask(shape, missing, seed, least=4):
    """Return a mask of seen points, at least some in every frame."""
    order = np.random.default_rng(seed).random(shape)
    rank = order.argsort(axis=1).argsort(axis=1)
    return (order >= missing) | (rank >= shape[1] - least)


def centred_tracks(tracks):
    """Return centred tracks, their centroids and sizes."""
    rows, report = centred_frames(tracks.transpose(0, 2, 1))
    return rows.transpose(0, 2, 1), report.translation, report.size


def unit_rows(centred, sizes):
    """Return tracks as frames (n_frames, 2, n_points) of size one."""
    return (centred / sizes[:, None, None]).transpose(0, 2, 1)


def completed(tracks, n_components, **params):
    """Return tracks in place of those with missing points."""
    centred, translation, sizes = centred_tracks(tracks)
    rows = unit_rows(centred, sizes)
    filled = filled_in(rows, completion_model(rows, 3 * n_components + 3, **params))
    assert_allclose(filled.mean(axis=2), 0, atol=1e-12)
    # Seen points are the given ones minus a shift.
    filled += np.nanmean(rows - filled, axis=2, keepdims=True)
    return sizes[:, None, None] * filled.transpose(0, 2, 1) + translation[:, None]


def held_out_error(tracks, seen, n_components, usable=None):
    """Return the inverse SNR of the hidden points, frames of unit size."""
    filled = completed(hide(tracks, seen), n_components)
    _, translation, sizes = centred_tracks(hide(tracks, seen))
    weights = sizes**-2.0
    hidden = ~seen if usable is None else ~seen & usable[:, None]
    error = np.sum((filled - tracks) ** 2, axis=2)
    energy = np.sum((tracks - translation[:, None]) ** 2, axis=2)
    weights = np.where(hidden, weights[:, None], 0.0)
    return np.sum(weights * error) / np.sum(weights * energy)


# --- what it returns ----------------------------------------------------------------


def test_seen_points_are_kept():
    scene = make_face_tracks(50, missing=0.3, random_state=0)
    filled = completed(scene.tracks, 3)
    assert_allclose(filled[scene.visible], scene.tracks[scene.visible], rtol=1e-13)


# --- the model ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def small():
    """Return frames of a small noisy table, with a complete and a repeated pattern."""
    scene = make_nonrigid_tracks(24, 9, 1, noise=0.1, random_state=0)
    seen = random_mask((24, 9), 0.3, 0)
    seen[5:8] = True
    seen[10:13] = seen[10]
    centred, _, sizes = centred_tracks(hide(scene.tracks, seen))
    return centred, seen, sizes


def log_likelihood(B, noise, centred, seen, sizes):
    """Return that of all rows, as said by normal densities without translation."""
    total = 0.0
    for frame, mask, size in zip(centred, seen, sizes, strict=True):
        n = mask.sum()
        # Contrasts of the seen points: an orthonormal basis of what sums to zero.
        contrasts = np.linalg.svd(np.ones((1, n)))[2][1:]
        covariance = contrasts @ (B[:, mask].T @ B[:, mask]) @ contrasts.T
        covariance += noise * np.eye(n - 1)
        for row in (contrasts @ frame[mask] / size).T:
            total -= 0.5 * row @ np.linalg.solve(covariance, row)
            total -= 0.5 * np.linalg.slogdet(covariance)[1]
    return total


def test_missing_points_are_conditional_expectations(small):
    centred, seen, sizes = small
    filled = completed(centred, 1)  # rank 6 of 9 points
    model = completion_model(unit_rows(centred, sizes), 6)
    far = 1e7  # variance of the translation, which may be anything
    covariance = model.B.T @ model.B + model.noise * np.eye(9) + far
    for frame, mask, result in zip(centred, seen, filled, strict=True):
        inverse = np.linalg.inv(covariance[np.ix_(mask, mask)])
        gain = covariance[np.ix_(~mask, mask)] @ inverse
        assert_allclose(result[~mask], gain @ frame[mask], atol=1e-5)


def test_the_fit_is_a_stationary_point_of_the_likelihood(small, rng):
    centred, _, sizes = small
    rows = unit_rows(centred, sizes)
    model = completion_model(rows, 3, tol=-1.0, max_iter=2000)  # never ends before
    best = log_likelihood(*model, *small)
    for _ in range(10):
        step = 1e-4 * rng.normal(size=model.B.shape) * np.std(model.B)
        near = model.B + step, model.B - step
        up, down = (log_likelihood(B, model.noise, *small) for B in near)
        assert abs(up - down) < 1e-6
        assert max(up, down) < best
    near = 1.001 * model.noise, model.noise / 1.001
    up, down = (log_likelihood(model.B, noise, *small) for noise in near)
    assert abs(up - down) < 1e-6
    assert max(up, down) < best


# --- exact tables -------------------------------------------------------------------


@pytest.mark.parametrize("seed", slow_after(1, range(3)))
@pytest.mark.parametrize(
    ("n_frames", "n_points", "n_components", "missing"),
    [(60, 30, 2, 0.2), (60, 30, 3, 0.3), (300, 68, 5, 0.3), (300, 68, 9, 0.2)],
)
def test_tables_without_noise(n_frames, n_points, n_components, missing, seed):
    scene = make_nonrigid_tracks(n_frames, n_points, n_components, random_state=seed)
    seen = random_mask((n_frames, n_points), missing, seed)
    determined = seen.sum(axis=1) >= 3 * n_components + 4
    assert determined.mean() > 0.95
    error = held_out_error(scene.tracks, seen, n_components, determined)
    assert np.sqrt(error) < 1e-7


def seen_from_outside(n_frames, n_points, least_cosine, seed):
    """Return tracks of points on an opaque ball, and which of them the camera sees."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n_points, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    cameras = Rotation.random(n_frames, rng).as_matrix()
    image = points @ cameras.transpose(0, 2, 1)
    return image[..., :2], image[..., 2] > least_cosine


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("least_cosine", [-0.3, 0.0])
def test_a_ball_of_which_every_frame_sees_one_side(least_cosine, seed):
    tracks, seen = seen_from_outside(100, 30, least_cosine, seed)
    assert not seen.all(axis=1).any()
    assert seen.mean() < 0.7
    assert np.sqrt(held_out_error(tracks, seen, 0)) < 1e-6


def test_points_that_are_never_seen_together():
    tracks, seen = seen_from_outside(200, 40, 0.3, 0)
    together = seen.T.astype(float) @ seen
    assert np.mean(together == 0) > 0.1
    assert np.sqrt(held_out_error(tracks, seen, 0)) < 1e-6


# --- tables with noise --------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_the_error_is_near_the_noise(noise):
    scene = make_nonrigid_tracks(400, 68, 3, noise=noise, random_state=0)
    seen = random_mask((400, 68), 0.3, 0)
    # The hidden points have noise of their own; the prediction adds to it.
    assert noise**2 < held_out_error(scene.tracks, seen, 3) < 2 * noise**2


# Inverse SNR in percent of hidden points of some frames, a little above what is
# reached; filling in with the centroid has 100, the mean of the 5 nearest frames 0.7.
@pytest.mark.parametrize(
    ("name", "n_components", "largest"),
    [
        ("ict_bu3dfe_like_68", 9, 0.06),
        ("faces_wild_68_combined", 9, 0.20),
        ("akhter_drink", 3, 0.016),
    ],
)
def test_random_points_of_real_tables(load_data, name, n_components, largest):
    tracks = load_data(name)["W2d"]
    tracks = tracks[:: max(len(tracks) // 200, 1)]
    seen = random_mask(tracks.shape[:2], 0.3, 0)
    assert 100 * held_out_error(tracks, seen, n_components) < largest


def test_faces_that_hide_a_side(load_data):
    tracks = load_data("muct_68")["W2d"].astype(float)
    seen = ~np.isnan(tracks).any(axis=2)
    complete = seen.all(axis=1)
    # The sides that other frames hide, on frames of which they are known.
    known, patterns = tracks[complete], seen[~complete]
    mask = np.ones(known.shape[:2], dtype=bool)
    mask[:: len(known) // len(patterns)][: len(patterns)] = patterns
    assert 100 * held_out_error(known, mask, 9) < 0.4


# --- degenerate tables --------------------------------------------------------------


def assert_completes(tracks, seen, n_components):
    """Complete without warnings and with finite numbers; return the relative error."""
    assert np.isfinite(completed(hide(tracks, seen), n_components)).all()
    return np.sqrt(held_out_error(tracks, seen, n_components))


def test_shark_has_a_lower_rank(load_data):
    tracks = load_data("shark_torresani")["W2d"].astype(float)
    seen = random_mask(tracks.shape[:2], 0.3, 0)
    for n_components in (1, 2, 6):
        assert assert_completes(tracks, seen, n_components) < 1e-5


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rigid_objects_and_more_basis_shapes(dtype):
    tracks = make_nonrigid_tracks(200, 40, 0, random_state=0).tracks.astype(dtype)
    seen = random_mask((200, 40), 0.3, 0)
    assert assert_completes(tracks, seen, 5) < 3e-4


def test_flat_objects(rng):
    tracks = rng.normal(size=(40, 2)) @ rng.normal(size=(200, 2, 2)) + 5
    assert assert_completes(tracks, random_mask((200, 40), 0.3, 0), 1) < 1e-5


@pytest.mark.parametrize(("n_frames", "n_points"), [(8, 13), (8, 68), (30, 100)])
def test_the_smallest_tables(n_frames, n_points):
    tracks = make_nonrigid_tracks(n_frames, n_points, 3, random_state=0).tracks
    assert_completes(tracks, random_mask((n_frames, n_points), 0.1, 3), 3)


def test_points_and_frames_that_are_rarely_seen():
    tracks = make_nonrigid_tracks(100, 30, 3, random_state=0).tracks
    seen = np.ones((100, 30), dtype=bool)
    seen[6:, 3] = False
    seen[50:, 4:] = False
    assert_completes(tracks, seen, 3)
    seen[90:, 1:] = False
    rows = unit_rows(hide(tracks - tracks[:, :1], seen), np.ones(100))
    assert np.isfinite(filled_in(rows, completion_model(rows, 12))).all()


# --- noise of the rigid model -------------------------------------------------------


@pytest.mark.parametrize("missing", [0.0, 0.3, 0.6])
def test_noise_of_a_rigid_object(missing):
    scene = make_nonrigid_tracks(500, 30, 0, noise=0.05, random_state=0)
    tracks = hide(scene.tracks, random_mask((500, 30), missing, 0))
    centred, *_ = centred_tracks(tracks)
    variance = completion_model(unit_rows(centred, np.ones(500)), 3).noise
    assert_allclose(variance, scene.noise_variance, rtol=0.05)
