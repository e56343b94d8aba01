import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.analysis._dynamics import (
    Dynamics,
    Observations,
    estimated_dynamics,
    observations,
    sequences_of,
    smoothed,
    smoothed_posterior,
)
from isa_nrsfm.datasets import make_nonrigid_tracks

K = 3


def random_dynamics(seed=0, size=0.9):
    """Return a stable transition and innovations that keep the covariance I."""
    rng = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(rng.normal(size=(K, K)))
    F = size * Q
    return Dynamics(F, np.eye(K) - F @ F.T, np.eye(K))


def simulated(dynamics, n_steps, rng):
    """Return coefficients (n_steps, K) that follow an autoregression."""
    F, Q, _ = dynamics
    root = np.linalg.cholesky(Q)
    x = [rng.normal(size=K)]
    for _ in range(n_steps - 1):
        x.append(F @ x[-1] + root @ rng.normal(size=K))
    return np.array(x)


def observed(x, rng, noise=0.3):
    """Return posteriors of noisy frames by themselves, with the prior N(0, I)."""
    half = rng.normal(size=(len(x), K, K))
    precision = half @ half.swapaxes(1, 2) / noise**2
    root = np.linalg.cholesky(np.linalg.inv(precision))
    seen = x + (root @ rng.normal(size=(len(x), K, 1)))[..., 0]
    covariance = np.linalg.inv(precision + np.eye(K))
    return (covariance @ precision @ seen[..., None])[..., 0], covariance


def dense_posterior(data, dynamics):
    """Return mean and covariance of all steps as one normal distribution."""
    F, Q, _ = dynamics
    n = len(data.information)
    prior = np.zeros((n, K, n, K))
    cov = np.eye(K)
    for t in range(n):
        cov = cov if t == 0 else F @ cov @ F.T + Q
        across = cov
        for s in range(t, n):
            prior[s, :, t], prior[t, :, s] = across, across.T
            across = F @ across
    inverse = np.linalg.inv(prior.reshape(n * K, n * K)).reshape(n, K, n, K)
    for t in range(n):
        inverse[t, :, t] += data.precision[t]
    covariance = np.linalg.inv(inverse.reshape(n * K, n * K))
    mean = (covariance @ data.information.ravel()).reshape(n, K)
    return mean, covariance.reshape(n, K, n, K)


class TestSmoother:
    @pytest.mark.parametrize("gaps", [False, True])
    def test_is_the_posterior_of_the_joint_normal_distribution(self, gaps):
        rng, dynamics = np.random.default_rng(0), random_dynamics()
        dynamics = dynamics._replace(innovation=dynamics.innovation + 0.3 * np.eye(K))
        data = observations(*observed(simulated(dynamics, 12, rng), rng))
        if gaps:
            for each in data:
                each[[0, 4, 5, 11]] = 0.0
        mean, covariance = dense_posterior(data, dynamics)
        got = smoothed(data, dynamics)
        assert_allclose(got.mean, mean, atol=1e-10)
        for t in range(12):
            assert_allclose(got.covariance[t], covariance[t, :, t], atol=1e-10)
        for t in range(11):
            assert_allclose(got.lagged[t], covariance[t + 1, :, t], atol=1e-10)

    def test_likelihood_is_that_of_the_joint_normal_distribution(self):
        rng = np.random.default_rng(4)
        data = observations(*observed(rng.normal(size=(6, K)), rng))
        values = []
        for dynamics in (random_dynamics(0), random_dynamics(1, 0.5)):
            mean, covariance = dense_posterior(data, dynamics)
            size = (6 * K, 6 * K)
            precision = np.linalg.inv(covariance.reshape(size))
            prior = precision - block_diag(*data.precision)
            dense = mean.ravel() @ precision @ mean.ravel()
            dense += np.linalg.slogdet(prior)[1] - np.linalg.slogdet(precision)[1]
            values.append((smoothed(data, dynamics).log_likelihood, dense / 2))
        assert_allclose(*np.transpose(values))


class TestEstimation:
    @pytest.mark.slow
    def test_finds_the_autoregression(self):
        rng, true = np.random.default_rng(0), random_dynamics()
        data = [
            observations(*observed(simulated(true, 400, rng), rng, 0.5))
            for _ in range(3)
        ]
        found = estimated_dynamics(data, 30, 1e-4, False)
        assert_allclose(found.transition, true.transition, atol=0.06)
        assert_allclose(found.innovation, true.innovation, atol=0.06)

    @pytest.mark.parametrize("seed", range(8))
    def test_independent_frames_have_none(self, seed):
        rng = np.random.default_rng(seed)
        data = observations(*observed(rng.normal(size=(150, K)), rng, 1.0))
        assert estimated_dynamics([data], 100, 1e-4, False) is None

    def test_does_not_depend_on_the_basis(self):
        rng, true = np.random.default_rng(2), random_dynamics(2)
        data = observations(*observed(simulated(true, 200, rng), rng))
        R = np.linalg.qr(rng.normal(size=(K, K)))[0]
        turned = Observations(R @ data.precision @ R.T, data.information @ R.T)
        first = estimated_dynamics([data], 30, 1e-6, False)
        second = estimated_dynamics([turned], 30, 1e-6, False)
        assert_allclose(second.transition, R @ first.transition @ R.T, atol=1e-5)


class TestPeople:
    @pytest.mark.parametrize(("n_people", "n_frames"), [(60, 3), (20, 8), (4, 60)])
    def test_photos_in_any_order_have_no_dynamics(self, n_people, n_frames):
        rng = np.random.default_rng(0)
        person = np.repeat(np.arange(n_people), n_frames)
        x = np.sqrt(0.8) * rng.normal(size=(n_people, K))[person]
        x += np.sqrt(0.2) * rng.normal(size=x.shape)
        frames = observed(x, rng)
        options = {"max_gap": 10, "max_iter": 100, "tol": 1e-3}
        mean, _, scales = smoothed_posterior(*frames, None, person, **options)
        assert scales.shape == (0,)
        assert_array_equal(mean, frames[0])

    def test_videos_of_people_are_smoothed(self):
        rng, true = np.random.default_rng(0), random_dynamics()
        person = np.repeat(np.arange(5), 40)
        x = np.concatenate([simulated(true, 40, rng) for _ in range(5)])
        x = np.sqrt(0.5) * (x + rng.normal(size=(5, K))[person])
        frames = observed(x, rng, 0.5)
        options = {"max_gap": 10, "max_iter": 100, "tol": 1e-3}
        mean, covariance, scales = smoothed_posterior(*frames, None, person, **options)
        assert_allclose(scales, -1 / np.log(0.9), rtol=0.5)
        error = np.linalg.norm(mean - x)
        assert error < 0.7 * np.linalg.norm(frames[0] - x)
        # Deviations of the sum of motion and intercept hold.
        off = (mean - x) ** 2 / np.diagonal(covariance, axis1=1, axis2=2)
        assert 0.8 < off.mean() < 1.25


class TestSequences:
    def test_uneven_times_are_rounded_but_stay_apart(self):
        time = np.array([0.0, 0.9, 2.0, 2.2, 4.3])
        ((_, steps),), _ = sequences_of(time, np.zeros(5, int), 10)
        assert steps.tolist() == [0, 1, 2, 3, 5]


@pytest.fixture(scope="module")
def waving():
    """Return a model of a thing that waves, its table in order of time."""
    rng = np.random.default_rng(0)
    phase = 0.1 * np.arange(160)
    alpha = np.stack([np.sin(phase), np.cos(0.7 * phase)], axis=1)
    scene = make_nonrigid_tracks(
        n_frames=160, n_points=20, n_components=2, noise=0.0, random_state=0
    )
    shapes = scene.mean_shape + np.einsum("ik,kjc->ijc", alpha, scene.basis)
    tracks = shapes @ scene.motion.swapaxes(1, 2)
    tracks += 0.15 * tracks.std() * rng.normal(size=tracks.shape)
    tracks[rng.random(tracks.shape[:2]) < 0.4] = np.nan
    table = tracks.reshape(160, -1)
    return AffineNRSfM(2, random_state=0, scale_frames=False).fit(table), table


class TestSmooth:
    def test_ordered_frames_are_smoothed(self, waving):
        model, table = waving
        found = model.smooth(table)
        assert found.time_scales.shape == (2,)
        assert (found.alpha_std < 0.8 * model.alpha_std_).mean() > 0.9
        rough = np.abs(np.diff(model.alpha_, 2, axis=0)).mean()
        assert np.abs(np.diff(found.alpha, 2, axis=0)).mean() < 0.5 * rough

    def test_shuffled_frames_stay_as_they_are(self, waving):
        model, table = waving
        order = np.random.default_rng(1).permutation(len(table))
        found = model.smooth(table[order])
        assert found.time_scales.shape == (0,)
        expected = model.decompose(table[order])
        assert_allclose(found.alpha, expected.alpha, atol=1e-12)
        assert_allclose(found.alpha_std, expected.alpha_std, atol=1e-12)

    def test_times_say_where_the_gaps_are(self, waving):
        model, table = waving
        kept = np.r_[0:60, 66:160]
        blank = table.copy()
        blank[60:66] = np.nan
        expected = model.smooth(blank, time=np.arange(160) / 30)
        found = model.smooth(table[kept], time=kept / 30)
        assert_allclose(found.alpha, expected.alpha[kept], atol=1e-12)
        assert_allclose(found.time_scales, expected.time_scales)
        # Rows that nobody saw are filled in, and less certain.
        assert np.isfinite(expected.alpha).all()
        assert (expected.alpha_std[63] > expected.alpha_std[30]).all()

    def test_dates_are_seconds(self, waving):
        model, table = waving
        dates = np.datetime64("2026-01-01") + np.arange(160) * np.timedelta64(40, "ms")
        found = model.smooth(table, time=dates)
        expected = model.smooth(table, time=0.04 * np.arange(160))
        assert_allclose(found.time_scales, expected.time_scales, rtol=1e-6)

    def test_nothing_goes_from_group_to_group(self, waving):
        model, table = waving
        groups = np.repeat(["a", "b"], 80)
        found = model.smooth(table, groups=groups, max_iter=5, tol=0.0)
        mixed = np.argsort(np.tile(np.arange(80), 2), kind="stable")
        other = model.smooth(table[mixed], groups=groups[mixed], max_iter=5, tol=0.0)
        assert_allclose(other.alpha, found.alpha[mixed], atol=1e-10)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"time": np.zeros(160)}, "row 1 has 0 after 0 of row 0"),
            ({"time": np.r_[np.nan, np.arange(159)]}, "missing in 1 of 160.*row 0"),
            ({"time": np.arange(9)}, "each of the 160 frames; got 9"),
            ({"groups": np.arange(160)}, "no group has two rows"),
            ({"groups": ["a"] * 9}, "each of the 160 frames; got 9"),
            ({"groups": ["a"] * 159 + [None]}, "missing in 1 of 160.*row 159"),
            ({"max_gap": 0}, "max_gap"),
        ],
    )
    def test_refusals(self, waving, options, message):
        model, table = waving
        with pytest.raises(ValueError, match=message):
            model.smooth(table, **options)

    # Whether FastICA converges on one basis shape depends on the version of SciPy.
    @pytest.mark.filterwarnings("ignore:PooledFastICA did not converge")
    def test_needs_a_posterior(self, waving):
        _, table = waving
        model = AffineNRSfM(1, refinement=None, random_state=0).fit(table)
        with pytest.raises(ValueError, match="refinement='joint'"):
            model.smooth(table)
