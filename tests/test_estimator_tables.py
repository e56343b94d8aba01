"""AffineNRSfM on real and degenerate tables: layouts, accuracy, finite numbers."""

import warnings

import numpy as np
import pytest
from layers import Quick, may_not_converge, slow_after, with_limits
from numpy.testing import assert_allclose, assert_array_equal
from scenes import images, random_scene, table_of
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

REAL_TABLES = (
    "akhter_yoga muct_68 hands_kazuhito_21 akhter_drink akhter_pickup "
    "flag_mocap_30x250 expressions_dlib_68 faces_wild_68_combined ict_bu3dfe_like_68 "
    "shark_torresani"
).split()
FAST = FastISA(n_init=2)
AllStarts = with_limits()
FACES = make_face_tracks(60, n_components=2, random_state=0).tracks


def real_tracks(load_data, name):
    """Return the tracks of the frames with all points."""
    tracks = load_data(name)["W2d"].astype(float)
    return tracks[~np.isnan(tracks).any(axis=(1, 2))]


# --- layout -------------------------------------------------------------------------


@pytest.mark.parametrize("right", ["interleaved", "planar"])
@pytest.mark.parametrize("name", slow_after(3, REAL_TABLES))
def test_right_layout_gives_no_warning_and_the_wrong_one_does(load_data, name, right):
    # Planar tables stand in for those whose frames count by size.
    options = {"scale_frames": right == "interleaved", "refinement": None, "isa": FAST}
    table = table_of(real_tracks(load_data, name), right)
    for layout in ("interleaved", "planar"):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            AffineNRSfM(1, layout=layout, random_state=0, **options).fit(table)
        found = [str(w.message) for w in caught if w.category is not ConvergenceWarning]
        if layout == right:
            assert found == []
        else:
            better = f"layout='{right}' explains the table much better"
            assert found[-1].startswith(better)


# --- degenerate tables --------------------------------------------------------------


def fitted(tracks, n_components, kind=AffineNRSfM, **params):
    """Return the model of tracks by the paper's pipeline, if nothing else is said.

    Warnings of ISA's convergence do not count.
    """
    params = {"isa": FAST, "refinement": "alternating", "random_state": 0} | params
    table = table_of(tracks)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
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


def rigid_tracks(flat=(1, 1, 1)):
    """Return the tracks of a rigid object."""
    return random_scene(0, 40, 20, 0, extent=flat).tracks


FLAT = pytest.mark.parametrize("flat", [[1, 1, 1], [1, 1, 0], [1, 0, 0]], ids=str)


@FLAT
def test_rigid_objects_have_no_basis_shapes(flat):
    model = fitted(rigid_tracks(flat), 5)
    assert model.inverse_snr_ < 1e-25
    assert_zero_from(model, 0)
    rank = sum(flat)
    second = np.linalg.eigvalsh(model.mean_shape_.T @ model.mean_shape_ / 20)
    assert_allclose(second, [0] * (3 - rank) + [1] * rank, atol=1e-12)


@pytest.mark.parametrize("n_components", slow_after(1, [2, 1]))
@FLAT
@pytest.mark.parametrize(
    "independence", slow_after(1, ["shapes", "coefficients", None])
)
def test_joint_refinement_of_rigid_objects(flat, n_components, independence):
    model = jointly(rigid_tracks(flat), n_components, independence=independence)
    # The objective is a difference of sums of squares, which are rounded.
    assert model.inverse_snr_ < np.finfo(float).eps
    assert_zero_from(model, 0)


@pytest.mark.parametrize("loss", slow_after(1, ["huber", "cauchy"]))
def test_robust_fit_of_a_rigid_object(loss):
    model = jointly(rigid_tracks(), 1, loss=loss)
    assert model.inverse_snr_ < 1e-10
    assert np.linalg.norm(model.basis_) < 1e-6 * np.linalg.norm(model.mean_shape_)


def lines_and_tiny_frames():
    """Return tracks of which three frames hardly show anything."""
    tracks = FACES.copy()
    tracks[3] *= [1, 0]
    tracks[5] = tracks[5].mean(axis=0) + 1e-7 * tracks[5]
    tracks[7] = tracks[7, :1]
    tracks[7, 0] += 1.0
    return tracks


def test_frames_that_are_lines_or_tiny_and_two_places_only(rng):
    for scale_frames in (True, False):
        fitted(lines_and_tiny_frames(), 2, scale_frames=scale_frames)
    tracks = np.repeat(rng.normal(size=(40, 2, 2)), 10, axis=1)
    assert fitted(tracks, 1).inverse_snr_ < 1e-25
    assert jointly(tracks, 1).inverse_snr_ < 1e-20
    # ... on the diagonal of the image: in the other layout all points are equal.
    diagonal = np.repeat(rng.normal(size=(40, 2, 1)), 10, axis=1) * [1, 1]
    assert fitted(diagonal, 1).inverse_snr_ < 1e-25


@pytest.mark.parametrize(
    ("k", "loss"),
    slow_after(
        1, [*((k, "linear") for k in (1, 2, 3, 6)), (2, "huber"), (2, "cauchy")]
    ),
)
def test_joint_refinement_of_the_shark(load_data, k, loss):
    # The refinement has hardly an end where the table determines so little. Most points
    # hardly move: those that do are no outliers.
    tracks = real_tracks(load_data, "shark_torresani")[::8]
    model = jointly(tracks, k, repeat=k == 1, kind=Quick, loss=loss, max_iter=100)
    assert model.inverse_snr_ < fitted(tracks, k).inverse_snr_


@pytest.mark.parametrize(
    ("n_different", "n_components", "seed"),
    slow_after(1, [(1, 5, 0), (3, 1, 0), (2, 2, 0), (3, 5, 4)]),
)
def test_joint_refinement_of_repeated_frames(n_different, n_components, seed):
    tracks = np.random.default_rng(seed).normal(size=(n_different, 20, 2))
    model = jointly(np.repeat(tracks, 12, axis=0), n_components)
    assert model.inverse_snr_ < 1e-9
    assert ((model.reliability_ >= 0) & (model.reliability_ < 1 + 1e-12)).all()
    for i in range(n_different):
        same = model.alpha_[12 * i : 12 * i + 12]
        assert_allclose(same, same[:1].repeat(12, axis=0), atol=1e-6)


def test_joint_refinement_of_duplicated_points_and_frames():
    tracks = FACES[:40, ::2]
    once = jointly(tracks, 2)
    # A point that is seen twice tells a little more of the noise, a frame counts twice.
    twice = np.concatenate([tracks, tracks[:, ::-1]], axis=1)
    points = jointly(twice, 2)
    assert_allclose(points.inverse_snr_, once.inverse_snr_, rtol=1e-2)
    assert_allclose(points.basis_[:, 34:], points.basis_[:, 33::-1], atol=1e-6)
    frames = jointly(np.tile(tracks, (2, 1, 1)), 2)
    assert_allclose(frames.alpha_[40:], frames.alpha_[:40], atol=1e-9)
    assert_allclose(frames.inverse_snr_, once.inverse_snr_, rtol=1e-2)


@pytest.mark.parametrize(
    ("n_components", "n_cameras", "noise"),
    slow_after(
        2,
        [
            *((1, 1, 0.0), (1, None, 0.01), (1, 2, 0.02), (2, 1, 0.0), (2, 2, 0.02)),
            *((3, None, 0.0), (3, None, 0.01)),
        ],
    ),
)
def test_joint_refinement_of_flat_objects_or_views(n_components, n_cameras, noise):
    # All frames from one place, or from two: depth is seen in part or not at all.
    extent, kind = ((1, 1, 1), AllStarts) if n_cameras else ((1, 1, 0), AffineNRSfM)
    scene = random_scene(0, 40, 20, 1, deformation=0.2, extent=extent)
    which = np.repeat(np.arange(n_cameras or 40), 40 // (n_cameras or 40))
    tracks = images(scene.shapes, scene.motion[which], scene.translation, scene.alpha)
    tracks += noise * np.random.default_rng(1).normal(size=tracks.shape)
    model = jointly(tracks, n_components, kind=kind)
    assert model.inverse_snr_ < 1e-9 + 2 * noise**2


@pytest.mark.parametrize(
    ("n_components", "dtype"), slow_after(1, [(1, np.float64), (2, np.float32)])
)
def test_joint_refinement_of_smallest_tables(n_components, dtype):
    rng = np.random.default_rng(n_components)
    n_frames = -(-8 * (n_components + 2) // 5)
    tracks = rng.normal(size=(n_frames, 3 * n_components + 4, 2)).astype(dtype)
    model = jointly(tracks, n_components, repeat=n_components == 1)
    # Random points have no common shape: the prior may leave basis shapes out.
    deviation = model.alpha_.std(axis=0)
    if dtype == np.float64:
        assert_allclose(deviation[model.basis_.any(axis=(1, 2))], 1, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loss", "scale_frames"), [("linear", False), ("huber", True), ("cauchy", False)]
)
def test_joint_refinement_of_frames_that_are_lines_or_tiny(loss, scale_frames):
    tracks = lines_and_tiny_frames()
    model = jointly(tracks, 2, loss=loss, scale_frames=scale_frames)
    others = np.setdiff1d(np.arange(60), [3, 5, 7])
    models, table = (model, jointly(FACES, 2)), table_of(tracks)
    errors = [each.reproject(table)[others] - table[others] for each in models]
    assert np.median(np.abs(errors[0])) < 2 * np.median(np.abs(errors[1]))


# --- accuracy -----------------------------------------------------------------------


@may_not_converge
@pytest.mark.parametrize(
    ("name", "n_components", "scale_frames", "percent"),
    slow_after(
        2,
        [
            ("shark_torresani", 1, False, 0.160),
            ("ict_bu3dfe_like_68", 9, True, 0.108),
            ("akhter_drink", 3, True, 0.150),
            ("faces_wild_68_combined", 9, True, 0.360),
        ],
    ),
)
def test_inverse_snr_of_tables(load_data, name, n_components, scale_frames, percent):
    table = table_of(real_tracks(load_data, name))
    params = {"refinement": "alternating", "scale_frames": scale_frames}
    model = AffineNRSfM(n_components, random_state=0, **params).fit(table)
    assert round(100 * model.inverse_snr_, 3) <= percent


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the depth of the shapes is not determined")
def test_calibrated_cameras_have_more_basis_shapes_than_the_factorisation():
    # 17 points allow 4 basis shapes with affine cameras. Bodies have many more: where
    # shapes had four directions, their error was 0.122. They have all that are found,
    # of which K are reported.
    bodies = make_body_tracks(200, camera="orthographic", random_state=0)
    fitted = AffineNRSfM(4, camera="orthographic", random_state=0)
    few, many = fitted.fit(bodies.data), clone(fitted).set_params(n_components=12)
    found = [each.reconstruct(bodies.data) for each in (few, many.fit(bodies.data))]
    errors = [mean_shape_error_3d(bodies.shapes, S, convention="frame") for S in found]
    assert max(errors) < 0.6 * 0.122
    assert errors[0] == pytest.approx(errors[1])
    assert many.basis_.shape == (12, 17, 3)
    assert many.singular_values_.shape == (16,)
    assert many.rank_floor_ < 1e-20
