"""AffineNRSfM on real and degenerate tables: accuracy, finite numbers."""

import warnings

import numpy as np
import pytest
from layers import Quick, slow_after
from numpy.testing import assert_allclose, assert_array_equal
from scenes import images, random_scene, table_of
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

FAST = FastISA(n_init=2)
FACES = make_face_tracks(40, n_components=2, random_state=0).tracks[:, ::2]


def real_tracks(load_data, name):
    """Return the tracks of the frames with all points."""
    tracks = load_data(name)["W2d"].astype(float)
    return tracks[~np.isnan(tracks).any(axis=(1, 2))]


# --- degenerate tables --------------------------------------------------------------


def fitted(tracks, n_components, kind=AffineNRSfM, **params):
    """Return the model of tracks by the paper's pipeline, if nothing else is said.

    Warnings of ISA's convergence do not count.
    """
    params = {"isa": FAST, "refinement": "alternating", "random_state": 0} | params
    table = table_of(tracks)
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):
        model = kind(n_components, **params).fit(table)
    for name, value in vars(model).items():
        known = name.endswith("_") and name != "mirror_certainty_"
        if known and isinstance(value, np.ndarray | float):
            assert np.isfinite(value).all(), name
    assert np.isfinite(model.reproject(table)).all()
    assert_allclose(model.transform(table), model.alpha_, atol=1e-9)
    assert model.rank_floor_ <= model.inverse_snr_ + 1e-25
    assert model.mean_shape_.shape == (tracks.shape[1], 3)
    assert model.basis_.shape == (n_components, tracks.shape[1], 3)
    assert np.isfinite(model.inverse_transform(np.zeros((2, n_components)))).all()
    return model


def jointly(tracks, n_components, repeat=False, **params):
    """Return the default model of tracks; it is finite, and the same if repeated.

    The table may determine little, then the refinement may not converge and say so;
    other warnings are errors.
    """
    params = {"refinement": "joint", "isa": None} | params
    model = fitted(tracks, n_components, **params)
    assert_array_equal(model.transform(table_of(tracks)), model.alpha_)
    if repeat:
        again = fitted(tracks, n_components, **params)
        assert_array_equal(again.alpha_, model.alpha_)
        assert_array_equal(again.basis_, model.basis_)
    return model


def assert_zero_from(model, first):
    """Assert that the basis shapes from `first` on have no motion."""
    assert np.all(model.basis_[first:] == 0)
    assert np.all(model.alpha_[:, first:] == 0)
    assert np.all(model.mode_covariance_[3 * first :] == 0)
    assert_allclose(model.alpha_[:, :first].std(axis=0), 1, rtol=1e-6)


@pytest.mark.parametrize(
    ("n_components", "refinement", "isa"),
    [(2, "alternating", FAST), (6, None, PooledFastICA(n_init=2))],
    ids=str,
)
def test_shark_has_one_shape_of_rank_two(load_data, n_components, refinement, isa):
    tracks = real_tracks(load_data, "shark_torresani")
    model = fitted(tracks, n_components, isa=isa, refinement=refinement)
    assert model.rank_floor_ < 1e-25
    assert np.linalg.matrix_rank(model.basis_[0], tol=1e-6) == 2
    assert_zero_from(model, 1)
    one = fitted(tracks, 1, isa=isa, refinement=refinement)
    assert_allclose(model.inverse_snr_, one.inverse_snr_, rtol=1e-6)
    by_size = fitted(tracks, 1, scale_frames=False)
    assert round(100 * by_size.inverse_snr_, 3) <= 0.160


def rigid_tracks(flat=(1, 1, 1)):
    """Return the tracks of a rigid object."""
    return random_scene(0, 40, 20, 0, extent=flat).tracks


@pytest.mark.parametrize("flat", [[1, 1, 1], [1, 1, 0], [1, 0, 0]], ids=str)
def test_rigid_objects_have_no_basis_shapes(flat):
    model = fitted(rigid_tracks(flat), 5)
    assert model.inverse_snr_ < 1e-25
    assert_zero_from(model, 0)
    rank = sum(flat)
    second = np.linalg.eigvalsh(model.mean_shape_.T @ model.mean_shape_ / 20)
    assert_allclose(second, [0] * (3 - rank) + [1] * rank, atol=1e-12)
    model = jointly(rigid_tracks(flat), 2)
    # The objective is a difference of sums of squares, which are rounded.
    assert model.inverse_snr_ < np.finfo(float).eps
    assert_zero_from(model, 0)


@pytest.mark.parametrize("loss", slow_after(1, ["huber", "cauchy"]))
def test_robust_fit_of_a_rigid_object(loss):
    model = jointly(rigid_tracks(), 1, loss=loss)
    assert model.inverse_snr_ < 1e-10
    assert np.linalg.norm(model.basis_) < 1e-6 * np.linalg.norm(model.mean_shape_)


@pytest.mark.parametrize(
    ("loss", "scale_frames"),
    slow_after(1, [("linear", False), ("huber", True), ("cauchy", False)]),
)
def test_frames_that_are_lines_or_tiny(loss, scale_frames):
    tracks = FACES.copy()
    tracks[3] *= [1, 0]
    tracks[5] = tracks[5].mean(axis=0) + 1e-7 * tracks[5]
    tracks[7] = tracks[7, :1]
    tracks[7, 0] += 1.0
    fitted(tracks, 2, scale_frames=scale_frames)
    model = jointly(tracks, 2, loss=loss, scale_frames=scale_frames)
    others = np.setdiff1d(np.arange(40), [3, 5, 7])
    models, table = (model, jointly(FACES, 2)), table_of(tracks)
    errors = [each.reproject(table)[others] - table[others] for each in models]
    assert np.median(np.abs(errors[0])) < 2 * np.median(np.abs(errors[1]))


@pytest.mark.parametrize(("k", "loss"), slow_after(1, [(1, "linear"), (2, "cauchy")]))
def test_joint_refinement_of_the_shark(load_data, k, loss):
    # The refinement has hardly an end where the table determines so little. Most points
    # hardly move: those that do are no outliers.
    tracks = real_tracks(load_data, "shark_torresani")[::8]
    model = jointly(tracks, k, repeat=k == 1, kind=Quick, loss=loss, max_iter=40)
    assert model.inverse_snr_ < fitted(tracks, k).inverse_snr_


def test_joint_refinement_of_duplicated_points_and_frames():
    once = jointly(FACES, 2)
    # A point that is seen twice tells a little more of the noise, a frame counts twice.
    points = jointly(np.concatenate([FACES, FACES[:, ::-1]], axis=1), 2)
    assert_allclose(points.inverse_snr_, once.inverse_snr_, rtol=1e-2)
    assert_allclose(points.basis_[:, 34:], points.basis_[:, 33::-1], atol=1e-6)
    frames = jointly(np.tile(FACES, (2, 1, 1)), 2)
    assert_allclose(frames.alpha_[40:], frames.alpha_[:40], atol=1e-9)
    assert_allclose(frames.inverse_snr_, once.inverse_snr_, rtol=1e-2)


def noise(*shape):
    return np.random.default_rng(1).normal(size=shape)


def places(n_axes):
    """Return tracks of two places: anywhere, or on the diagonal of the image.

    There all points are equal in the other layout.
    """
    return np.repeat(noise(40, 2, n_axes), 10, axis=1) * np.ones(2)


def repeated(n_different):
    """Return tracks of frames that are there twelve times."""
    return np.repeat(noise(n_different, 20, 2), 12, axis=0)


def smallest(n_components):
    """Return tracks of the smallest table. Random points have no common shape."""
    n_frames = -(-8 * (n_components + 2) // 5)
    return noise(n_frames, 3 * n_components + 4, 2)


def views(n_cameras, deviation):
    """Return tracks of an object: depth is seen in part or not at all."""
    scene = random_scene(0, 40, 20, 1, deformation=0.2)
    motion = np.repeat(scene.motion[:n_cameras], 40 // n_cameras, axis=0)
    tracks = images(scene.shapes, motion, scene.translation, scene.alpha)
    return tracks + deviation * noise(*tracks.shape)


def flat(deviation):
    """Return tracks of a flat object."""
    options = {"deformation": 0.2, "extent": (1, 1, 0), "noise": deviation}
    return random_scene(0, 40, 20, 1, **options).tracks


# Tracks, numbers of basis shapes, and the largest inverse SNR
LITTLE = {
    "two places": (lambda: places(2), 1, 1e-20),
    "on the diagonal": (lambda: places(1), 1, 1e-20),
    "equal frames": (lambda: repeated(1), 5, 1e-9),
    "smallest": (lambda: smallest(1), 1, 1.0),
    "flat": (lambda: flat(0.01), 1, 2e-4),
    "three frames": (lambda: repeated(3), 5, 1e-9),
    "smallest, single precision": (lambda: smallest(2).astype(np.float32), 2, 1.0),
    "one view": (lambda: views(1, 0.0), 1, 1e-9),
    "two views": (lambda: views(2, 0.02), 2, 8e-4),
    "flat, more basis shapes": (lambda: flat(0.0), 3, 1e-9),
}


@pytest.mark.parametrize("name", slow_after(5, LITTLE))
def test_joint_refinement_where_the_table_determines_little(name):
    make_tracks, n_components, most = LITTLE[name]
    tracks = make_tracks()
    if name in ("two places", "on the diagonal"):
        assert fitted(tracks, 1).inverse_snr_ < 1e-25
    model = jointly(tracks, n_components, repeat=name == "smallest")
    assert model.inverse_snr_ < most
    assert ((model.reliability_ >= 0) & (model.reliability_ < 1 + 1e-12)).all()
    if tracks.dtype == np.float64:  # the prior may leave basis shapes out
        seen = model.basis_.any(axis=(1, 2))
        assert_allclose(model.alpha_.std(axis=0)[seen], 1, rtol=1e-6)
    if "frames" in name:
        for same in np.split(model.alpha_, len(tracks) // 12):
            assert_allclose(same, same[:1].repeat(12, axis=0), atol=1e-6)


# --- accuracy -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the depth of the shapes is not determined")
def test_calibrated_cameras_have_more_basis_shapes_than_the_factorisation():
    # 17 points allow 4 basis shapes with affine cameras. Bodies have many more: where
    # shapes had four directions, their error was 0.122. They have all that are found,
    # of which K are reported.
    bodies = make_body_tracks(200, camera="orthographic", random_state=0)
    few = AffineNRSfM(4, camera="orthographic", random_state=0).fit(bodies.data)
    many = clone(few).set_params(n_components=12).fit(bodies.data)
    errors = [
        mean_shape_error_3d(
            bodies.shapes, each.reconstruct(bodies.data), convention="frame"
        )
        for each in (few, many)
    ]
    assert max(errors) < 0.6 * 0.122
    assert errors[0] == pytest.approx(errors[1])
    assert many.basis_.shape == (12, 17, 3)
