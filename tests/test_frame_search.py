"""Fits of single frames: exactness, invariances and degenerate input, all cameras."""

import numpy as np
import pytest
import scenes
from frame_parts import (
    assert_calibrated,
    assert_same_fits,
    camera_and_alpha,
    fit_posterior,
    numbers_of,
)
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from scenes import images, random_rotation, random_scene, with_gaps

from isa_nrsfm._frames.models import FrameMap, PosteriorFrames, frame_search
from isa_nrsfm._frames.point_sums import frame_tracks
from isa_nrsfm._tables.blocks import block_slices

NOISE = 0.02
CAMERA = pytest.mark.parametrize(
    "camera", ["affine", "weak_perspective", "orthographic"]
)
GAPS = pytest.mark.parametrize("gaps", [False, True])


def scene_of(camera, gaps=False, noise=NOISE, n_frames=20):
    """Return a scene of three basis shapes, maybe with missing points."""
    scene = random_scene(
        0,
        n_frames,
        noise=noise,
        camera=camera,
        deformation=0.2,
        extent=(1.0, 0.8, 0.6),
    )
    return scene._replace(tracks=with_gaps(scene.tracks)) if gaps else scene


def fitted(scene, camera, noise=NOISE**2, **given):
    return fit_posterior(scene.tracks, scene.shapes, noise, camera, **given)


@CAMERA
class TestExact:
    @GAPS
    def test_truth_is_found(self, camera, gaps):
        scene = scene_of(camera, gaps, noise=0.0)
        fits = fitted(scene, camera, 0.0)
        for got, true in zip(
            camera_and_alpha(fits), camera_and_alpha(scene), strict=True
        ):
            assert_allclose(got, true, atol=1e-8)
        assert fits.converged.all()
        assert_allclose(fits.objective, 0, atol=1e-9)

    @GAPS
    def test_position_is_that_of_least_squares(self, camera, gaps):
        scene = scene_of(camera, gaps)
        rest = scene.tracks - images(
            scene.shapes, *camera_and_alpha(fitted(scene, camera))
        )
        assert_allclose(np.nanmean(rest, axis=1), 0.0, atol=1e-12)

    @GAPS
    def test_prepared_and_rough_frames(self, camera, gaps):
        scene = scene_of(camera, gaps)
        frames = frame_tracks(
            scene.tracks.transpose(0, 2, 1), np.isfinite(scene.tracks[..., 0]) * 1.0
        )
        search = frame_search(camera, scene.shapes)
        expected = fitted(scene, camera)
        assert_same_fits(search.fit(frames, NOISE**2), expected, 1e-8)
        rough = search.fit(frames, NOISE**2, rough=True)
        away = np.abs(rough.motion - expected.motion).max(axis=(1, 2))
        assert np.median(away) < 0.1


@CAMERA
class TestInvariance:
    def test_frames_are_separate(self, camera):
        scene = scene_of(camera)
        scene.tracks[10:] = with_gaps(scene.tracks[10:])
        scene.tracks[15, 3:] = np.nan
        noise = np.geomspace(1e-6, 1.0, 20)
        together = fitted(scene, camera, noise)
        assert np.isnan(together.alpha[15]).all()
        for i in range(20):
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

    def test_fits_are_the_same_without_covariances(self, camera):
        scene = scene_of(camera)
        scene.tracks[10:] = with_gaps(scene.tracks[10:])
        starts = np.ones((2, 3))
        expected = fitted(scene, camera, starts=starts)._asdict()
        got = fitted(scene, camera, starts=starts, covariances=False)._asdict()
        assert got.pop("covariance").shape == (20, 0, 0)
        assert np.isnan(got.pop("turn_covariance")).all()
        for name, value in got.items():
            assert_array_equal(value, expected[name])

    @GAPS
    def test_rotation_and_position_of_single_images(self, camera, gaps):
        scene = scene_of(camera, gaps)
        R = np.array([random_rotation(seed, 2) for seed in range(20)])
        R[::2] = R[::2] @ np.diag([1.0, -1.0])  # some are reflected
        turned = scene.tracks @ R.swapaxes(1, 2) + 100.0
        expected = fitted(scene, camera)
        got = fitted(scene._replace(tracks=turned), camera)
        assert_allclose(got.motion, R @ expected.motion, atol=1e-8)
        assert_allclose(got.alpha, expected.alpha, atol=1e-8)
        assert_allclose(got.covariance, expected.covariance, atol=1e-8)

    @GAPS
    @pytest.mark.parametrize("unit", [1e-100, 1e-6, 1e6, 1e100])
    def test_units(self, camera, gaps, unit):
        # Of single images, or of the whole table and the shapes
        scene = scene_of(camera, gaps)
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

    def test_weights_count_points_so_often(self, camera):
        scene = scene_of(camera)
        weights = np.random.default_rng(1).integers(0, 3, size=20)
        often = np.repeat(np.arange(20), weights)
        shapes = scene.shapes[..., often]
        shapes = shapes - shapes.mean(axis=2, keepdims=True)
        repeated = scene._replace(tracks=scene.tracks[:, often], shapes=shapes)
        expected = fitted(repeated, camera)
        got = fitted(scene, camera, weights=np.tile(1.0 * weights, (20, 1)))
        assert_allclose(got.motion, expected.motion, atol=1e-8)
        assert_allclose(got.alpha, expected.alpha, atol=1e-8)


# What is done to shapes (4, 3, n_points), in place
KINDS = {
    "flat mean shape": lambda B: B[0, 2].fill(0),
    "flat": lambda B: B[:, 2].fill(0),
    "on a line": lambda B: B[:, 1:].fill(0),
    "no mean shape": lambda B: B[0].fill(0),
    "no basis shape": lambda B: B[2].fill(0),
    "rigid": lambda B: B[1:].fill(0),
    "a point": lambda B: B.fill(0),
    "equal basis shapes": lambda B: np.copyto(B[2], B[1]),
    "basis shape that a camera makes": lambda B: np.copyto(
        B[1], np.diag([1.0, 2.0, 3.0]) @ B[0]
    ),
    "basis shape that a scale makes": lambda B: np.copyto(B[1], 0.5 * B[0]),
    "basis shape that a turn makes": lambda B: np.copyto(
        B[1], np.array([[0, -0.2, 0], [0.2, 0, 0], [0, 0, 0]]) @ B[0]
    ),
    "huge basis shapes": lambda B: np.multiply(B[1:], 1e6, out=B[1:]),
    "tiny basis shapes": lambda B: np.multiply(B[1:], 1e-9, out=B[1:]),
}


@CAMERA
class TestDegenerate:
    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("variance", slow_after(1, [0.0, NOISE**2]))
    def test_stays_finite_and_no_worse_than_rigid(self, camera, kind, variance):
        scene = scene_of(camera)
        shapes = scene.shapes.copy()
        KINDS[kind](shapes)
        shapes = random_rotation(5) @ shapes
        for tracks in (scene.tracks, with_gaps(scene.tracks)):
            starts = np.ones((2, 3))
            fits = fit_posterior(tracks, shapes, variance, camera, starts=starts)
            for each in numbers_of(fits):
                assert np.isfinite(each).all()
            variances = np.diagonal(fits.covariance, axis1=1, axis2=2)
            assert (variances >= 0).all()
            if camera == "affine":
                rigid = fit_posterior(tracks, shapes[:1], 1.0)
                assert (fits.objective <= rigid.objective * (1 + 1e-6)).all()

    def test_no_basis_shape_is_the_rigid_fit(self, camera):
        scene = scene_of(camera)
        fits = fitted(scene._replace(shapes=scene.shapes[:1]), camera)
        assert fits.alpha.shape == (20, 0)
        assert fits.covariance.shape == (20, 0, 0)
        assert fits.converged.all()
        if camera == "affine":
            W = scene.centred.swapaxes(1, 2)
            expected = W @ np.linalg.pinv(scene.shapes[0])
            assert_allclose(fits.motion, expected, atol=1e-11)

    def test_basis_shape_of_zeros_has_the_prior(self, camera):
        scene = scene_of(camera)
        padded = np.concatenate([scene.shapes, np.zeros_like(scene.shapes[:1])])
        expected = fitted(scene, camera)
        fits = fitted(scene._replace(shapes=padded), camera)
        assert_array_equal(fits.alpha[:, 3], 0.0)
        assert_allclose(fits.covariance[:, 3, 3], 1.0)
        assert_allclose(fits.alpha[:, :3], expected.alpha, atol=1e-8)

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
        assert not fits.converged[~expected].any()

    @pytest.mark.parametrize("variance", [0.0, NOISE**2])
    def test_all_points_of_a_frame_equal(self, camera, variance):
        scene = scene_of(camera, n_frames=3)
        scene.tracks[1] = scene.tracks[1, 0]
        fits = fitted(scene, camera, variance)
        for each in numbers_of(fits):
            assert np.isfinite(each).all()
        # The centroids are what it shows.
        rest = scene.tracks - images(scene.shapes, *camera_and_alpha(fits))
        assert_allclose(rest.mean(axis=1), 0.0, atol=1e-12)
        if camera == "affine":
            assert_allclose(fits.motion[1], 0, atol=1e-12)
            assert_allclose(fits.alpha[1], 0, atol=1e-12)

    def test_no_frames(self, camera):
        scene = scene_of(camera)
        fits = fitted(scene._replace(tracks=np.zeros((0, 20, 2))), camera)
        assert fits.motion.shape == (0, 2, 3)


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
@pytest.mark.parametrize(
    ("extent", "dtype", "share"),
    [
        ((1.0, 1.0, 0.5), float, 0.7),
        ((1.0, 1.0, 0.5), np.float32, 0.7),
        # Frames whose reversed camera is the better one are left to the other search.
        ((1.0, 1.0, 0.02), float, 0.4),
        ((3.0, 0.1, 1.0), float, 0.7),
        ((1.0, 1.0, 0.0), float, 0.0),
    ],
)
def test_is_the_fit_of_the_frame_among_others(camera, extent, dtype, share):
    model, tracks = model_and_tracks(camera, extent=extent)
    rows = np.ascontiguousarray(tracks.transpose(0, 2, 1), dtype=dtype)
    together = model.posterior(rows)
    for i in range(len(tracks)):
        assert_same(model.posterior(rows[[i]]), together.take([i]))
    assert sum(
        model.single_search.fit(row, NOISE**2) is not None for row in rows
    ) >= share * len(rows)


@pytest.mark.parametrize("camera", CAMERAS)
def test_is_a_minimum_of_the_documented_objective(camera):
    model, tracks = model_and_tracks(camera, 1)
    fit = model.single_search.fit(tracks[0].T, NOISE**2)
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
    for frame in rows[[0, 1, 3]]:
        assert model.single_search.fit(frame, NOISE**2) is None


@pytest.mark.parametrize("length", [1, 2, 5, 11, 12, 40])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 11, 12, 13])
def test_no_block_of_several_has_one_frame(n, length):
    slices = block_slices(n, length)
    assert [i for part in slices for i in range(n)[part]] == list(range(n))
    lengths = [part.stop - part.start for part in slices]
    assert all(1 < each <= length + 1 for each in lengths[-1:] if n > 1)
    assert lengths[:-1] == [length] * (len(slices) - 1)
