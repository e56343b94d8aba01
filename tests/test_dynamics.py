from functools import partial

import numpy as np
import pandas as pd
import pytest
from layers import slow_after
from made_once import made_once
from numpy.testing import assert_allclose
from refusals import refusals_of
from scenes import table_of, tracks_of, waving_scene, with_gaps
from scipy.linalg import block_diag
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from scipy.special import logit

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.camera_models import CAMERAS, full_rotations
from isa_nrsfm._frames.models import FrameMap, LinearisedFrames
from isa_nrsfm._linalg import frames_first, frames_last
from isa_nrsfm.analysis._smoothing import (
    Dynamics,
    estimated_dynamics,
    expected_gradient,
    smooth,
    smoothed,
)
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

K = 3
# Of fits that are compared with each other
FEW_STEPS = {"max_iter": 2, "tol": 0.0}


def some_dynamics(n_walks=0, share=0.3, n_shares=K):
    """Return dynamics of K coefficients, and of parameters of cameras."""
    rates, walks = np.log([0.05, 0.3, 2.0]), np.linspace(-1.0, 1.0, n_walks)
    return Dynamics(rates, walks, np.full(n_shares, logit(share)))


def simulated(n_steps, rng, dynamics):
    """Return parameters (n_steps, p) that follow the dynamics."""
    F, Q, first, shown = dynamics.matrices()
    # Signs of an eigendecomposition, the default, differ between machines.
    draw = partial(rng.multivariate_normal, np.zeros(len(F)), method="cholesky")
    z = [draw(first)]
    for _ in range(n_steps - 1):
        z.append(F @ z[-1] + draw(Q))
    return np.array(z) @ shown.T


def observed(x, rng, noise=0.3):
    """Return noisy observations of parameters (n_steps, p).

    Parameters of cameras have an origin near their value in each step.
    """
    n_steps, n = x.shape
    half = rng.normal(size=(n_steps, n, n))
    precision = half @ half.swapaxes(1, 2) / noise**2
    root = np.linalg.cholesky(np.linalg.inv(precision))
    off = (root @ rng.normal(size=(n_steps, n, 1)))[..., 0]
    change = np.diff(x, axis=0, prepend=0.0) + 0.1 * rng.normal(size=x.shape)
    change[:, :K] = 0.0
    seen = x + off - np.cumsum(change, axis=0)
    # The fits of frames by themselves have the prior N(0, I) of the coefficients.
    posterior = precision + np.diag(np.arange(n) < K)
    fit = np.linalg.solve(posterior, precision @ seen[..., None])[..., 0]
    # Parameters of cameras are relative to these fits.
    change[:, K:] += np.diff(fit[:, K:], axis=0, prepend=0.0)
    fit[:, K:] = 0.0
    return precision, fit, change


def alone(x, rng, noise=0.3):
    """Return frames by themselves of coefficients (n_frames, K), without cameras."""
    precision, alpha, _ = observed(x, rng, noise)
    covariance, blank = np.linalg.inv(precision + np.eye(K)), np.zeros((len(x), 2, 3))
    parts = blank, blank[..., 0], alpha, covariance, precision, np.zeros((len(x), K, 2))
    return LinearisedFrames(*parts)


def smooth_people(frames, groups):
    """Smooth frames of cameras without parameters."""
    given = FrameMap.identity(K), type(CAMERAS["affine"])(held=True), None, groups
    return smooth(frames, *given, max_gap=10, max_iter=100, tol=0.1, dtype=float)


def dense_posterior(data, dynamics):
    """Return mean, covariance and log-likelihood of all steps as one normal density."""
    F, Q, first, shown = dynamics.matrices()
    precision, fit, change = data
    n_steps, (n, size) = len(fit), shown.shape
    # All states from the first one and all noise, in order
    before = np.kron(np.eye(n_steps, k=-1), F)
    across = np.kron(np.eye(n_steps), shown) @ np.linalg.inv(
        np.eye(len(before)) - before
    )
    prior = across @ block_diag(first, *[Q] * (n_steps - 1)) @ across.T
    change = np.pad(change, ((0, 0), (0, size - n)))
    change[0] = 0.0
    mean, fit, L = (-across @ change.ravel(), fit.ravel(), block_diag(*precision))
    growth, far = np.eye(len(prior)) + L @ prior, mean - fit
    covariance, off = np.linalg.solve(growth.T, prior).T, fit - L @ far
    likelihood = far @ (fit + off) + off @ covariance @ off
    likelihood = 0.5 * (likelihood - np.linalg.slogdet(growth)[1])
    mean = (mean + covariance @ off).reshape(n_steps, n)
    return mean, covariance.reshape(n_steps, n, n_steps, n), likelihood


def test_coefficients_have_the_matern_covariance():
    dynamics = some_dynamics(n_shares=0)
    rate = np.exp(dynamics.rates)
    F, Q, first, shown = dynamics.matrices()
    assert_allclose(F @ first @ F.T + Q, first, atol=1e-15)
    across = first
    for t in range(5):
        expected = np.diag((1 + rate * t) * np.exp(-rate * t))
        assert_allclose(shown @ across @ shown.T, expected, atol=1e-15)
        across = F @ across
    # With intercepts they keep variance one.
    _, _, first, shown = some_dynamics(2).matrices()
    assert_allclose((shown @ first @ shown.T)[:K, :K], np.eye(K))


@pytest.mark.parametrize(("n_walks", "n_shares"), [(0, 0), (2, K)])
class TestSmoother:
    @pytest.mark.parametrize("gaps", [False, True])
    def test_is_the_posterior_of_the_joint_normal_distribution(
        self, gaps, n_walks, n_shares, rng
    ):
        dynamics = some_dynamics(n_walks, n_shares=n_shares)
        data = observed(rng.normal(size=(9, K + n_walks)), rng)
        if gaps:
            for each in data[:2]:
                each[[0, 4, 5, 8]] = 0.0
        mean, covariance, likelihood = dense_posterior(data, dynamics)
        means, covariances, value, _ = smoothed(data, dynamics)
        # Cameras have prior variances of 1e6 to 1e8, with rounding errors to match.
        atol = 1e-6 if n_walks else 1e-10
        assert_allclose(means, mean, atol=atol)
        expected = [covariance[t, :, t] for t in range(9)]
        assert_allclose(covariances, expected, atol=atol)
        assert_allclose(value, likelihood)

    def test_gradient_is_that_of_the_likelihood(self, n_walks, n_shares, rng):
        dynamics = some_dynamics(n_walks, n_shares=n_shares)
        data = observed(rng.normal(size=(9, K + n_walks)), rng)
        splits = np.cumsum([len(each) for each in dynamics])[:-1]

        def likelihood(parameters):
            return smoothed(data, Dynamics(*np.split(parameters, splits)))[2]

        expected = approx_fprime(np.concatenate(dynamics), likelihood, 1e-5)
        got = expected_gradient(dynamics, smoothed(data, dynamics)[3], 8, 1)
        assert_allclose(got, expected, rtol=1e-3, atol=2e-3)


def test_rates_are_found(rng):
    true = some_dynamics(1, n_shares=0)
    data = observed(simulated(150, rng, true), rng, 0.2)
    found = estimated_dynamics([data], K, False, 30, 1.0)
    assert_allclose(found.rates, true.rates, atol=0.5)
    assert_allclose(found.walks, true.walks, atol=0.5)


class TestPeople:
    def test_photos_in_any_order_have_no_dynamics(self, rng):
        person = np.arange(4).repeat(15)
        x = np.sqrt(0.8) * rng.normal(size=(4, K))[person]
        x += np.sqrt(0.2) * rng.normal(size=x.shape)
        assert not len(smooth_people(alone(x, rng), person).time_scales)

    def test_photos_of_one_unusual_person_have_none(self, rng):
        frames = alone(1.5 + 0.4 * rng.normal(size=(60, K)), rng)
        assert not len(smooth_people(frames, None).time_scales)

    def test_videos_of_people_are_smoothed(self, rng):
        person = np.repeat(np.arange(8), 30)
        true = Dynamics(np.full(K, np.log(0.3)), np.empty(0), np.empty(0))
        x = np.concatenate([simulated(30, rng, true) for _ in range(8)])
        x = np.sqrt(0.5) * (x + rng.normal(size=(8, K))[person])
        frames = alone(x, rng, 0.5)
        found = smooth_people(frames, person)
        assert_allclose(found.time_scales, 1 / 0.3, rtol=0.3)
        error = np.linalg.norm(found.alpha - x)
        assert error < 0.7 * np.linalg.norm(frames.alpha - x)
        # Deviations of the sum of process and intercept hold.
        assert 0.8 < np.mean(((found.alpha - x) / found.alpha_std) ** 2) < 1.25


@pytest.mark.parametrize("name", CAMERAS)
def test_steps_between_cameras_move_one_to_the_other(name, rng):
    camera = CAMERAS[name]
    motion = camera.nearest(rng.normal(size=(40, 2, 3)))
    start, end = motion[:20], motion[20:]
    moved = camera.moved(frames_last(start), camera.steps_between(start, end).T)
    assert_allclose(moved, frames_last(end), atol=1e-12)


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
@pytest.mark.parametrize("name", slow_after(1, ["affine", "weak_perspective"]))
def test_likelihood_of_frames_is_linearised(name, loss):
    scene = make_nonrigid_tracks(60, 12, 2, camera=name, noise=0.02, random_state=0)
    table = with_gaps(scene.data + 50, 0.2)
    tracks, row = tracks_of(table), 7
    rows, options = tracks.mT, {"camera": name, "loss": loss, "random_state": 0}
    model = AffineNRSfM(2, **options, scale_frames=False).fit(table)
    alone, frames = model._model.linearised(rows), model._model.frames
    points, k = np.isfinite(tracks[row, :, 0]), len(frames.shapes) - 1
    start = np.append(alone.alpha[row], np.zeros(CAMERAS[name].n_parameters))

    def images(x):
        shape = frames.shapes[0] + np.tensordot(x[:k], frames.shapes[1:], 1)
        M = CAMERAS[name].moved(frames_last(alone.motion[[row]]), x[k:, None])
        return (frames_first(M)[0] @ shape)[:, points]

    steps = 1e-4 * np.eye(len(start))
    T = np.array([images(start + h) - images(start - h) for h in steps]) / 2e-4
    if loss == "linear":
        assert_allclose(alone.slope[row], T.mean(axis=2), rtol=1e-6, atol=1e-6)
        T = (T - T.mean(axis=2, keepdims=True)).reshape(len(T), -1)
        constant, slope = frames.certainty.images
        noise = frames.noise_variance * model._frame_sizes[row] ** 2
        noise *= constant + slope * (1 + np.sum(alone.alpha[row] ** 2))
        assert_allclose(alone.precision[row], T @ T.T / noise, rtol=1e-5, atol=1e-2)
    # The posterior covariance has the Hessian, the precision that of Gauss-Newton.
    whole = alone.precision[row] + np.diag(np.arange(len(start)) < k)
    ratio = np.linalg.solve(alone.covariance[row], np.linalg.inv(whole)[:k, :k])
    assert_allclose(np.linalg.eigvals(ratio), 1.0, atol=0.2)


@made_once
def waving_model(n_frames=60):
    """Return a model of a thing that waves, and first rows of its table in time."""
    rng = np.random.default_rng(0)
    tracks = waving_scene(100, 20, [0.1, 0.07])[0].tracks
    tracks += 0.15 * tracks.std() * rng.normal(size=tracks.shape)
    table = table_of(with_gaps(tracks, 0.4))
    model = AffineNRSfM(2, random_state=0, scale_frames=False).fit(table)
    return model, table[:n_frames]


def smoothed_waves(**options):
    model, table = waving_model()
    return model.smooth(table, **options)


class TestSmooth:
    def test_cameras_are_smoothed(self, rng):
        t, shapes = np.arange(100), waving_scene(100, 20, [0.1, 0.07])[0].shapes
        turns = np.stack([0.3 * np.sin(0.1 * t), 0.05 * t, 0.2 * np.cos(0.05 * t)], 1)
        truth = shapes @ Rotation.from_rotvec(turns).as_matrix().mT
        tracks = truth[..., :2] + 0.1 * truth.std() * rng.normal(size=(100, 20, 2))
        options = {"camera": "orthographic", "scale_frames": False, "random_state": 0}
        table = table_of(tracks)
        model = AffineNRSfM(2, **options).fit(table)

        def error(fit):
            turned, _ = full_rotations(fit.motion)
            return mean_shape_error_3d(truth, model.reconstruct(fit) @ turned.mT)

        smooth = model.smooth(table).decomposition
        assert error(smooth) < 0.7 * error(model.decompose(table))

    def test_ordered_frames_are_smoothed(self):
        model, table = waving_model(100)
        found = model.smooth(table)
        assert found.time_scales.shape == (2,)
        assert (found.alpha_std < 0.8 * model.alpha_std_).mean() > 0.9
        rough = np.abs(np.diff(model.alpha_, 2, axis=0)).mean()
        assert np.abs(np.diff(found.alpha, 2, axis=0)).mean() < 0.5 * rough

    def test_times_or_dates_say_where_the_gaps_are(self):
        model, table = waving_model()
        kept, blank = np.r_[0:36, 42:60], table.copy()
        blank[36:42] = np.nan
        seconds = 3600.0 * np.arange(60)
        expected = model.smooth(blank, time=seconds, **FEW_STEPS)
        # Rows that nobody saw are filled in, and less certain.
        assert np.isfinite(expected.alpha).all()
        assert (expected.alpha_std[39] > expected.alpha_std[20]).all()
        # Hours before and after a change of the clocks
        dates = pd.date_range("2024-03-30", periods=60, freq="h", tz="Europe/Berlin")
        dates = dates[kept]
        utc = dates.tz_convert(None).to_numpy()
        for time in (utc, pd.Series(dates), list(dates.to_pydatetime())):
            found = model.smooth(table[kept], time=time, **FEW_STEPS)
            assert_allclose(found.alpha, expected.alpha[kept], atol=1e-12)
            assert_allclose(found.time_scales, expected.time_scales)

    def test_uneven_times_are_rounded_but_stay_apart(self):
        model, table = waving_model()
        time = np.r_[0.0, 0.9, 2.0, 2.2, 4.3 + np.arange(56)]
        found = model.smooth(table, time=time, **FEW_STEPS)
        expected = model.smooth(table, time=np.r_[0:4, 5:61], **FEW_STEPS)
        assert_allclose(found.alpha, expected.alpha, atol=1e-12)

    def test_nothing_goes_from_group_to_group(self):
        model, table = waving_model()
        groups = np.repeat(["a", "b"], 30)
        found = model.smooth(table, groups=groups, **FEW_STEPS)
        mixed = np.argsort(np.tile(np.arange(30), 2), kind="stable")
        other = model.smooth(table[mixed], groups=groups[mixed], **FEW_STEPS)
        assert_allclose(other.alpha, found.alpha[mixed], atol=1e-10)

    def test_frames_of_four_points_have_no_weight(self):
        model, table = waving_model()
        few, blank = tracks_of(table.copy()), table.copy()
        few[30, 4:], blank[30] = np.nan, np.nan
        found, expected = (
            model.smooth(X, **FEW_STEPS).alpha for X in (table_of(few), blank)
        )
        assert_allclose(found, expected, atol=1e-12)

    @pytest.mark.parametrize("kind", ["shuffled", "one seen", "none seen"])
    def test_frames_without_dynamics_stay_as_they_are(self, kind):
        model, table = waving_model()
        if kind == "shuffled":
            table = np.random.default_rng(1).permutation(table)
        else:
            n_seen = int(kind == "one seen")
            table = np.where(np.arange(4)[:, None] < n_seen, table[:4], np.nan)
        found, expected = model.smooth(table), model.decompose(table)
        assert found.time_scales.shape == (0,)
        assert_allclose(found.alpha, expected.alpha, atol=1e-12)
        assert_allclose(found.alpha_std, expected.alpha_std, atol=1e-12)


test_refusals = refusals_of("dynamics", globals())
