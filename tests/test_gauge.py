"""The canonical space, order, scale and sign, and the independent basis."""

from typing import NamedTuple

import numpy as np
import pytest
from frame_parts import assert_calibrated
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scenes import random_cameras, random_rotation

from isa_nrsfm._frames.camera_models import CAMERAS, mean_view
from isa_nrsfm._frames.gauge import canonical_gauge, independent_gauge
from isa_nrsfm._parameters import INDEPENDENCE

ALL = [*INDEPENDENCE, None]
EACH = pytest.mark.parametrize("independence", ALL)


class Fit(NamedTuple):
    shapes: NDArray  # (n_components + 1, 3, n_points), centred
    motion: NDArray  # (n_frames, 2, 3)
    alpha: NDArray  # (n_frames, n_components)

    def images(self):
        """Return the images of the shapes (n_frames, 2, n_points)."""
        return self.motion @ self.frames()

    def frames(self):
        """Return the shapes of the frames (n_frames, 3, n_points)."""
        return self.shapes[0] + np.tensordot(self.alpha, self.shapes[1:], 1)


def random_fit(seed=0, n_frames=60, n_points=80, n_components=3, scattered=False):
    """
    Return a fit with independent heavy-tailed basis shapes and coefficients.

    Its cameras see the object from about one side, or scattered ones from all sides.
    """
    rng = np.random.default_rng(seed)
    shapes = rng.normal(size=(n_components + 1, 3, n_points))
    shapes[1:] *= 0.3 * rng.normal(size=(n_components, 1, n_points))
    shapes -= shapes.mean(axis=2, keepdims=True)
    motion = rng.normal(size=(n_frames, 2, 3)) + 2 * np.eye(2, 3)
    alpha = rng.laplace(size=(n_frames, n_components)) / np.sqrt(2)
    if scattered:
        motion = random_cameras(rng, n_frames) @ np.diag([1.0, 2.0, 3.0])
    return Fit(shapes, motion, alpha)


def random_mixing(seed, n_shapes, shift=0.05):
    """
    Return a mixing of the mean shape and the basis shapes.

    The basis is mixed and shifted a little along the mean shape, so that the scales of
    all frames stay positive, and the mean shape is shifted along the basis.
    """
    mixing = np.random.default_rng(seed).normal(size=(n_shapes, n_shapes))
    mixing[0] *= 0.3
    mixing[0, 0] = 1.0
    mixing[1:, 0] *= shift
    return mixing


def remixed(alpha, mixing):
    """Return the coefficients (..., n_components) of mixed shapes, and the scales."""
    c = np.insert(alpha, 0, 1.0, axis=-1) @ np.linalg.inv(mixing)
    assert (c[..., 0] > 0).all()
    return c[..., 1:] / c[..., :1], c[..., 0]


def regauged(fit, camera="affine", shift=0.05, mirrored=False):
    """Return another fit that is as good: mixed, in a space that is sheared.

    Of calibrated cameras space is turned, and orthographic ones absorb no scales.
    """
    shift = 0.0 if camera == "orthographic" else shift
    mixing, space = random_mixing(1, len(fit.shapes), shift), random_rotation(1)
    if camera == "affine":
        space += 0.3 * np.random.default_rng(1).normal(size=(3, 3))
        space[0] *= np.sign(np.linalg.det(space)) * (-1 if mirrored else 1)
    alpha, scale = remixed(fit.alpha, mixing)
    motion = scale[:, None, None] * fit.motion @ np.linalg.inv(space)
    return Fit(space @ np.tensordot(mixing, fit.shapes, 1), motion, alpha)


def canonical(fit, *options):
    """Return the canonical fit, and the standard deviations for unit covariances."""
    mean_shape, basis, frames = independent_gauge(*fit, *(options or ["shapes"]))
    n_frames, n_components = fit.alpha.shape
    covariance = np.tile(np.eye(n_components), (n_frames, 1, 1))
    motion, alpha, deviation = frames.apply(fit.motion, fit.alpha, covariance)
    shapes = np.concatenate([mean_shape[None], basis])
    return Fit(shapes.transpose(0, 2, 1), motion, alpha), deviation


def assert_same(got, expected, atol=1e-7):
    for name, one, other in zip(Fit._fields, got, expected, strict=True):
        assert_allclose(one, other, atol=atol, err_msg=name)


def assert_frontal(fit):
    """Assert that the nearest orthonormal rows to the mean camera are x and y."""
    view = mean_view(fit.motion)
    assert_allclose(view[:, 2], 0, atol=1e-13)
    assert_allclose(view[0, 1], view[1, 0], atol=1e-13)
    assert np.trace(view[:, :2]) > 0
    assert np.linalg.det(view[:, :2]) > 0
    assert np.sum(fit.shapes[0, 2] ** 3) > 0


def part_along(fit):
    """Return the parts of the basis shapes along the mean shape."""
    return np.einsum("kaj,aj->k", fit.shapes[1:], fit.shapes[0])


def assert_unit_coefficients(fit):
    assert_allclose(fit.alpha.mean(axis=0), 0, atol=1e-12)
    assert_allclose(fit.alpha.std(axis=0), 1, rtol=1e-12)


class TestConditions:
    @EACH
    def test_hold(self, independence):
        result, _ = canonical(regauged(random_fit()), independence)
        assert_frontal(result)
        assert_unit_coefficients(result)
        mean_shape, basis = result.shapes[0], result.shapes[1:]
        assert_allclose(result.shapes.mean(axis=2), 0, atol=1e-12)
        assert_allclose(mean_shape @ mean_shape.T / 80, np.eye(3), atol=1e-12)
        assert_allclose(part_along(result), 0, atol=80e-10)
        assert (np.sum(result.alpha**3, axis=0) >= 0).all()
        moved = result.motion[:, None] @ basis
        energy = np.sum((result.alpha[..., None, None] * moved) ** 2, axis=(0, 2, 3))
        assert (np.diff(energy) <= 0).all()


def calibrated(fit, camera):
    """Return a fit with cameras of a model."""
    return fit._replace(motion=CAMERAS[camera].nearest(fit.motion))


@EACH
@pytest.mark.parametrize(
    ("camera", "n_components", "scattered", "mirrored"),
    [
        ("affine", 1, False, False),
        ("affine", 3, False, False),
        ("affine", 3, True, False),
        ("affine", 3, True, True),
        ("weak_perspective", 3, False, False),
        ("orthographic", 3, False, False),
    ],
)
def test_gauge_of_the_fit_makes_no_difference(
    independence, camera, n_components, scattered, mirrored
):
    options = {"n_components": n_components, "n_points": 150, "scattered": scattered}
    fit = calibrated(random_fit(**options), camera)
    expected, _ = canonical(fit, independence, camera)
    other = regauged(fit, camera, shift=0.01, mirrored=mirrored)
    assert_allclose(other.images(), fit.images(), atol=1e-10)
    assert_same(canonical(other, independence, camera)[0], expected)


BOTH = pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])


@BOTH
@EACH
class TestCalibratedCameras:
    """Space may only be turned, and orthographic cameras absorb no scales."""

    @pytest.mark.parametrize("unit", [None, 3.0])
    def test_images_stay_and_cameras_stay_calibrated(self, camera, independence, unit):
        fit = calibrated(random_fit(), camera)
        options = independence, camera, unit
        result, _ = canonical(fit, *options)
        space = independent_gauge(*fit, *options)[-1].space
        assert_allclose(result.images(), fit.images(), atol=1e-10)
        size = np.linalg.norm(space, axis=0)
        assert_allclose(space @ space.T, size[0] ** 2 * np.eye(3), atol=1e-10)
        assert_calibrated(size[0] * result.motion, camera, 1e-10)
        assert_frontal(result)
        if unit is None:
            assert np.mean(result.shapes[0] ** 2) == pytest.approx(1.0)
        else:
            assert size[0] == pytest.approx(unit)
        assert_unit_coefficients(result)
        if camera == "weak_perspective":  # in the space of the cameras
            assert_allclose(part_along(result), 0, atol=1e-10)


def test_standard_deviations_are_those_of_random_coefficients():
    fit = random_fit()
    frames = independent_gauge(*fit, "shapes")[-1]
    rng = np.random.default_rng(3)
    root = 0.03 * rng.normal(size=(60, 3, 3))
    covariance = root @ root.swapaxes(1, 2)
    _, _, got = frames.apply(fit.motion, fit.alpha, covariance)
    n_draws = 2000
    noise = rng.normal(size=(n_draws, 60, 3))
    drawn = fit.alpha + np.einsum("ikl,nil->nik", root, noise)
    results = [frames.apply(fit.motion, each, covariance) for each in drawn]
    alpha = np.array([result[1] for result in results])
    assert_allclose(got, alpha.std(axis=0), rtol=5 / np.sqrt(2 * n_draws))


def emptied(part, fit):
    """Return a fit of which a part is zero, or does not vary."""
    if part == "mean shape":
        fit.shapes[0] = 0.0
    elif part == "one coefficient":
        fit.alpha[:, 1] = 0.3
    elif part == "one basis shape":
        fit.shapes[3] = 0.0
        fit.alpha[:, 2] = 0.0
    elif part == "underflow":
        for each in (fit.shapes[1:].T, fit.alpha):
            each *= [1e-147, 0.0, 1e-167]
    else:
        fit.alpha[:] = 0.0
        fit.shapes[1:] *= part == "coefficients"
    return fit


PARTS = ["mean shape", "one coefficient", "coefficients", "one basis shape", "basis"]
PARTS.append("underflow")


class TestDegenerate:
    @EACH
    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    @pytest.mark.parametrize("part", PARTS)
    def test_parts_that_are_zero_or_do_not_vary(self, independence, camera, part):
        fit = calibrated(emptied(part, random_fit()), camera)
        result, deviation = canonical(fit, independence, camera)
        for each in (*result, deviation):
            assert np.isfinite(each).all()
        assert_allclose(result.images(), fit.images(), atol=1e-9)
        if "basis" in part:
            n_moving = 2 if part == "one basis shape" else 0
            norms = np.linalg.norm(result.shapes[1:], axis=(1, 2))
            assert (norms[:n_moving] > 0.1).all()
            assert_allclose(norms[n_moving:], 0, atol=1e-9)

    @EACH
    @pytest.mark.parametrize(("flat", "unit"), [(1, 1e-9), (1, 1.0), (2, 1e9)])
    def test_flat_objects(self, independence, flat, unit):
        fit = random_fit()
        fit.shapes[:, 3 - flat :] = 0.0
        fit = fit._replace(shapes=unit * fit.shapes)
        other = regauged(fit)
        result, deviation = canonical(other, independence)
        assert np.isfinite(deviation).all()
        assert_allclose(result.images(), other.images(), atol=1e-10 * unit)
        assert_allclose(result.alpha.mean(axis=0), 0, atol=1e-12)
        if unit == 1.0:
            assert_allclose(part_along(result), 0, atol=1e-9)
        variances = np.linalg.eigvalsh(result.shapes[0] @ result.shapes[0].T / 80)
        assert_allclose(variances, np.arange(3) >= flat, atol=1e-9)
        # Directions that are exactly flat get the scale of the widest one.
        mean_shape, _, frames = independent_gauge(*fit, independence)
        before = np.linalg.solve(frames.space, mean_shape.T)
        widths = np.linalg.svd(before, compute_uv=False) / np.sqrt(80)
        widths[3 - flat :] = widths[0]
        scales = np.linalg.svd(frames.space, compute_uv=False)
        assert_allclose(scales, np.sort(1 / widths)[::-1])

    @pytest.mark.parametrize(
        ("part", "size", "factor"),
        [("alpha", 0.0, 0), ("basis", 1e-15, 0), ("basis", 1e-6, -7), (None, 1, -7)],
    )
    def test_factors_of_basis_shapes_that_hardly_move(self, part, size, factor):
        """Below rounding errors they are zero, else of unit mean square."""
        fit = random_fit()
        fit.alpha[:, 1] = -7.0 * (size if part == "alpha" else 1.0)
        fit.shapes[2] *= size if part == "basis" else 1.0
        shapes = fit.shapes.mT
        given = shapes[0], shapes[1:], fit.motion, fit.alpha, np.eye(3)
        _, basis, order, factors = canonical_gauge(*given)
        assert part is None or order[2] == 1
        assert factors[order == 1] == pytest.approx(factor)
        assert_allclose(basis, factors[:, None, None] * shapes[1:][order])

    @EACH
    @pytest.mark.parametrize("kind", ["flat", "thin", "far"])
    def test_parts_along_the_mean_shape_are_kept(self, independence, kind):
        """Of thin objects that bend, and where a frame would have a negative scale."""
        fit = random_fit()
        if kind == "far":  # a part along the mean shape, and a frame far out on it
            fit.shapes[1] -= 0.3 * fit.shapes[0]
            fit.alpha[7, 0] = 4.5
        else:
            fit.shapes[0, 2] *= 0.0 if kind == "flat" else 0.02
        result, deviation = canonical(fit, independence)
        assert np.isfinite(deviation).all()
        assert_allclose(result.images(), fit.images(), atol=1e-9)
        assert_unit_coefficients(result)
        # No frame is turned inside out, and none changes its scale.
        space = independent_gauge(*fit, independence)[-1].space
        assert_allclose(space @ fit.frames(), result.frames(), atol=1e-9)
