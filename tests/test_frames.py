"""The most probable camera, position and coefficients of frames, by Newton's method.

One contract for all cameras, complete, missing and weighted points: derivatives are
those of a dense objective, the fit is its minimum, covariances are inverse Hessians,
and the fit of a frame does not depend on the others.
"""

import numpy as np
import pytest
import scenes
from frame_parts import (
    Regression,
    assert_calibrated,
    assert_same_fits,
    camera_and_alpha,
    fit_posterior,
    numbers_of,
)
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less
from refusals import refusals_of
from scenes import images, random_cameras, random_rotation, with_gaps
from scipy.optimize import minimize

from isa_nrsfm._frames.camera_models import (
    CAMERAS,
)
from isa_nrsfm._frames.models import spread_starts
from isa_nrsfm._frames.search import (
    FrameSearch,
    frame_sums,
    frame_tracks,
)
from isa_nrsfm._linalg import frames_last, unpacked
from isa_nrsfm._tables import block_slices  # noqa: F401  in refusals.txt

NOISE = 0.02
CAMERA = pytest.mark.parametrize("camera", CAMERAS)
KINDS = pytest.mark.parametrize("kind", ["complete", "gaps", "weighted"])


def scene_of(camera, kind="complete", noise=NOISE, n_frames=20, depth=1.0):
    """Return a scene of three basis shapes, maybe with missing or weighted points."""
    options = {"noise": noise, "camera": camera, "deformation": 0.2}
    options["extent"] = (1.0, 0.8, 0.6 * depth)
    if kind == "weighted":
        options["kind"] = "missing"
    scene = scenes.random_scene(0, n_frames, **options)
    return scene._replace(tracks=with_gaps(scene.tracks)) if kind == "gaps" else scene


def fitted(scene, camera, noise=NOISE**2, **given):
    given = {"weights": scene.weights} | given
    return fit_posterior(scene.tracks, scene.shapes, noise, camera, **given)


def problem_of(scene, camera, noise):
    """Return the search, its frames, and cameras in its coordinates."""
    search = FrameSearch(scene.shapes, CAMERAS[camera])
    weights, seen = scene.weights, np.isfinite(scene.tracks[..., 0])
    if weights is None and not seen.all():
        weights = 1.0 * seen
    tracks = frame_tracks(scene.tracks.swapaxes(1, 2), weights)
    sums = frame_sums(tracks, search.shared)
    problem = search.problem(sums, np.full(len(scene.tracks), noise))
    return search, problem, frames_last(scene.motion @ np.linalg.inv(search.space))


def value(scene, i, M, noise=NOISE**2):
    return Regression.of(scene, i, M).value(noise)


def moved(camera, M, step):
    """Return a camera (2, 3) after a step of its parameters."""
    return CAMERAS[camera].moved(M[..., None], np.reshape(step, (-1, 1)))[..., 0]


def disturbed(M, camera, size):
    """Return cameras (2, 3, n) after random steps of their parameters."""
    shape = CAMERAS[camera].n_parameters, M.shape[2]
    return CAMERAS[camera].moved(M, size * np.random.default_rng(1).normal(size=shape))


def hessian_of(f, n, h=1e-3):
    """Return the Hessian (n, n) of a function of a step, by central differences."""
    hessian, steps = np.empty((n, n)), h * np.eye(n)
    for p, q in np.ndindex(n, n):
        a, b = steps[p], steps[q]
        hessian[p, q] = f(a + b) + f(-a - b) - f(a - b) - f(b - a)
    return hessian / (4 * h * h)


@KINDS
@CAMERA
class TestMinimum:
    def test_objective_rises_in_every_direction(self, camera, kind):
        scene = scene_of(camera, kind, n_frames=8)
        fits = fitted(scene, camera)
        if camera != "affine":
            assert_calibrated(fits.motion, camera)
        rest = scene.tracks - images(scene.shapes, *camera_and_alpha(fits))
        if scene.weights is not None:
            rest *= scene.weights[..., None]
        assert_allclose(np.nansum(rest, axis=1), 0.0, atol=1e-11)
        rng = np.random.default_rng(1)
        for i, M in enumerate(fits.motion):
            frame, least = Regression.of(scene, i, M), value(scene, i, M)
            assert_allclose(fits.alpha[i], frame.mean(NOISE**2), rtol=1e-9, atol=1e-12)
            square = frame.square(fits.alpha[i], NOISE**2)
            assert fits.objective[i] == pytest.approx(square, rel=1e-9)
            for _ in range(5):
                step = 1e-4 * rng.normal(size=CAMERAS[camera].n_parameters)
                ends = (moved(camera, M, sign * step) for sign in (1, -1))
                rises = [value(scene, i, end) - least for end in ends]
                assert min(rises) > 0
                # Equal on both sides: the slope is zero, not only small.
                assert_allclose(rises[0], rises[1], rtol=1e-2)

    def test_covariances_are_those_of_camera_and_coefficients_together(
        self, camera, kind
    ):
        deviation = 2e-3
        scene = scene_of(camera, kind, noise=deviation, n_frames=2)
        noise, n = deviation**2, CAMERAS[camera].n_parameters
        fits = fitted(scene, camera, noise)
        for i, M in enumerate(fits.motion):

            def f(x, i=i, M=M):
                frame = Regression.of(scene, i, moved(camera, M, x[:n]))
                return frame.square(fits.alpha[i] + x[n:], noise)

            # The posterior density is exp(-f / (2 s2)).
            expected = np.linalg.inv(hessian_of(f, n + 3) / (2 * noise))
            parts = [(fits.covariance[i], expected[n:, n:])]
            if camera != "affine":
                parts.append((fits.turn_covariance[i], expected[:3, :3]))
            for got, part in parts:
                assert_allclose(got, part, atol=2e-3 * np.abs(part).max())
        assert np.isnan(fits.turn_covariance).all() == (camera == "affine")


def reversed_cameras(scene):
    """Return cameras reflected at the plane of the mean shape."""
    axes = np.linalg.svd(scene.shapes[0], full_matrices=False)[0]
    return scene.motion @ axes @ np.diag([1.0, 1.0, -1.0]) @ axes.T


@CAMERA
def test_the_minimum_is_no_higher_than_from_other_starts(camera):
    # The depth of the object is that of the noise: the start can be reversed.
    scene, noise = scene_of(camera, "weighted", 0.05, n_frames=6, depth=0.1), 0.05**2
    fits = fitted(scene, camera, noise)
    random_ones = random_cameras(np.random.default_rng(1), 6)
    random_ones *= np.linalg.norm(fits.motion, axis=(1, 2))[:, None, None] / np.sqrt(2)
    reversed_ones = reversed_cameras(scene._replace(motion=fits.motion))
    starts = np.stack([reversed_ones, random_ones, scene.motion], axis=1)
    found, least = [], []
    for i, M in enumerate(fits.motion):
        ends = []
        for start in starts[i]:

            def end(step, i=i, start=start):
                return value(scene, i, moved(camera, start, step), noise)

            ends.append(minimize(end, np.zeros(CAMERAS[camera].n_parameters)).fun)
        found.append(value(scene, i, M, noise))
        least.append(min(ends))
    assert_array_less(found, np.array(least) + 1e-6)
    # Most of these searches end at the minimum.
    assert np.isclose(found, least, rtol=0, atol=1e-4).sum() >= 4


def half_hessian(search, problem, M, size=1e-5):
    """Return half the Hessian of s2 F (p, p, n), by differences of the slope."""
    rows = []
    for tangent in np.eye(search.model.n_parameters):
        step = np.tile(size * tangent[:, None], M.shape[2])
        below, above = (
            search.evaluate(problem, search.model.moved(M, sign * step)).slope
            for sign in (-1, 1)
        )
        rows.append((below - above) / (2 * size))
    # Differences of the slope along tangents that turn along: what is not symmetric is
    # the commutator of two rotations.
    hessian = np.array(rows)
    return 0.5 * (hessian + hessian.swapaxes(0, 1))


@KINDS
@CAMERA
def test_value_and_hessian_are_exact_but_for_the_determinant(camera, kind):
    # Away from the minimum. What is left falls like the noise.
    scene, errors = scene_of(camera, kind), []
    for noise in (1e-2, 1e-3, 1e-4):
        search, problem, M = problem_of(scene, camera, noise)
        values = [value(scene, i, each, noise) for i, each in enumerate(scene.motion)]
        found = search.evaluate(problem, M).value
        assert_allclose(found, noise * np.array(values), rtol=1e-9)
        M = disturbed(M, camera, 0.03)
        found = unpacked(search.evaluate(problem, M).hessian)
        expected = half_hessian(search, problem, M)
        size = np.abs(expected).max(axis=(0, 1))
        errors.append((np.abs(found - expected).max(axis=(0, 1)) / size).max())
    assert errors[0] < 0.1
    assert errors[1] < 0.15 * errors[0]
    assert errors[2] < 0.15 * errors[1]


@CAMERA
def test_truth_is_found_without_noise(camera):
    scene = scene_of(camera, "gaps", noise=0.0)
    fits = fitted(scene, camera, 0.0)
    for got, true in zip(camera_and_alpha(fits), camera_and_alpha(scene), strict=True):
        assert_allclose(got, true, atol=1e-8)
    assert_allclose(fits.objective, 0, atol=1e-9)


@CAMERA
class TestInvariance:
    def test_frames_are_separate(self, camera):
        scene = scene_of(camera, n_frames=8)
        scene.tracks[4:] = with_gaps(scene.tracks[4:])
        scene.tracks[6, 3:] = np.nan
        noise = np.geomspace(1e-6, 1.0, 8)
        together = fitted(scene, camera, noise)
        assert np.isnan(together.alpha[6]).all()
        for i in range(8):
            one = scene._replace(tracks=scene.tracks[i : i + 1])
            alone = fitted(one, camera, noise[i])
            for got, expected in zip(alone, together, strict=True):
                assert_allclose(got[0], expected[i], rtol=1e-8, atol=1e-9)

    def test_more_frames_than_a_block(self, camera):
        scene = scene_of(camera, n_frames=8)
        scene.tracks[::2] = with_gaps(scene.tracks[::2])
        often = np.tile(np.arange(8), 520)
        got = fitted(scene._replace(tracks=scene.tracks[often]), camera)
        assert_same_fits(got, fitted(scene, camera).take(often), 1e-10)

    @pytest.mark.parametrize("unit", [1e-100, 1e100])
    def test_units(self, camera, unit):
        # Of single images, or of the whole table and the shapes
        scene = scene_of(camera, "gaps")
        units, shapes = unit ** np.random.default_rng(1).random(20), scene.shapes
        if camera == "orthographic":
            units, shapes = np.full(20, unit), unit * shapes
        tracks = units[:, None, None] * scene.tracks
        expected = fitted(scene, camera)
        got = fitted(
            scene._replace(tracks=tracks, shapes=shapes), camera, (units * NOISE) ** 2
        )
        scale = 1.0 if camera == "orthographic" else units[:, None, None]
        assert_allclose(got.motion / scale, expected.motion, atol=1e-9)
        assert_allclose(got.alpha, expected.alpha, atol=1e-9)
        assert_allclose(got.covariance, expected.covariance, atol=1e-9)


def test_large_deformation_needs_further_starts():
    scene = scenes.random_scene(0, 40, noise=NOISE, deformation=2.0)
    starts = spread_starts(scene.alpha)
    given = ({}, {"initial": scene.alpha}, {"starts": starts})
    zero, from_truth, found = (fitted(scene, "affine", **g).objective for g in given)
    least = np.minimum(zero, from_truth)
    assert (zero > 1.1 * least).any()
    assert (found <= np.minimum(zero, 1.001 * least)).all()


# What is done to shapes (4, 3, n_points), in place
SHAPES = {
    "flat mean shape": lambda B: B[0, 2].fill(0),
    "flat": lambda B: B[:, 2].fill(0),
    "on a line": lambda B: B[:, 1:].fill(0),
    "no mean shape": lambda B: B[0].fill(0),
    "basis shape that a camera makes": lambda B: np.copyto(
        B[1], np.diag([1.0, 2.0, 3.0]) @ B[0]
    ),
    "huge basis shapes": lambda B: np.multiply(B[1:], 1e6, out=B[1:]),
    "tiny basis shapes": lambda B: np.multiply(B[1:], 1e-9, out=B[1:]),
}


@CAMERA
class TestDegenerate:
    @pytest.mark.parametrize("kind", SHAPES)
    def test_stays_finite_and_no_worse_than_rigid(self, camera, kind):
        scene = scene_of(camera, n_frames=8)
        shapes = scene.shapes.copy()
        SHAPES[kind](shapes)
        shapes = random_rotation(5) @ shapes
        scene.tracks[4:] = with_gaps(scene.tracks[4:])
        fits = fit_posterior(scene.tracks, shapes, 0.0, camera, starts=np.ones((2, 3)))
        for each in numbers_of(fits):
            assert np.isfinite(each).all()
        variances = np.diagonal(fits.covariance, axis1=1, axis2=2)
        assert (variances >= 0).all()
        if camera == "affine":
            rigid = fit_posterior(scene.tracks, shapes[:1], 1.0)
            assert (fits.objective <= rigid.objective * (1 + 1e-6)).all()

    def test_no_frames_and_no_basis_shape_which_is_the_rigid_fit(self, camera):
        scene = scene_of(camera)
        none = fitted(scene._replace(tracks=np.zeros((0, 20, 2))), camera)
        assert none.motion.shape == (0, 2, 3)
        fits = fitted(scene._replace(shapes=scene.shapes[:1]), camera)
        assert fits.alpha.shape == (20, 0)
        assert fits.covariance.shape == (20, 0, 0)
        if camera == "affine":
            W = scene.centred.swapaxes(1, 2)
            expected = W @ np.linalg.pinv(scene.shapes[0])
            assert_allclose(fits.motion, expected, atol=1e-11)

    def test_frames_that_determine_no_camera(self, camera):
        scene = scene_of(camera, n_frames=8)
        scene.shapes[0, 0, :6] = 0.3  # six points in a plane
        scene.shapes[0] -= scene.shapes[0].mean(axis=1, keepdims=True)
        tracks = scene.tracks
        tracks[0] = np.nan
        tracks[1, 1:] = np.nan
        tracks[2, 3:] = np.nan
        tracks[3, 6:] = np.nan
        tracks[4, :-4] = np.nan
        tracks[5, ::2, 0] = np.nan
        fits = fitted(scene, camera, starts=np.ones((1, 3)))
        expected = np.arange(8) >= 4
        for each in numbers_of(fits):
            finite = np.isfinite(each.reshape(8, -1))
            assert_array_equal(finite.all(axis=1), expected)
            assert_array_equal(finite.any(axis=1), expected)

    def test_all_points_of_a_frame_equal(self, camera):
        scene = scene_of(camera, n_frames=3)
        scene.tracks[1] = scene.tracks[1, 0]
        fits = fitted(scene, camera, 0.0)
        for each in numbers_of(fits):
            assert np.isfinite(each).all()
        # The centroids are what it shows.
        rest = scene.tracks - images(scene.shapes, *camera_and_alpha(fits))
        assert_allclose(rest.mean(axis=1), 0.0, atol=1e-12)
        if camera == "affine":
            assert_allclose(fits.motion[1], 0, atol=1e-12)
            assert_allclose(fits.alpha[1], 0, atol=1e-12)


test_refusals = refusals_of("frames", globals())
