"""What the coefficients do not depend on, and the gauge of the shapes."""

import numpy as np
import pytest
from layers import OneStart, may_not_converge, slow_after, start_may_not_converge
from numpy.testing import assert_allclose
from scenes import table_of
from sklearn.base import clone

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks

# The warning about the layout has tests of its own.
pytestmark = [
    pytest.mark.filterwarnings("ignore:layout=:UserWarning"),
    # Of the paper's pipeline: the joint refinement does not say so.
    start_may_not_converge,
]

VARIANTS = {
    "joint": {},
    "paper, fast": {"isa": FastISA(n_init=4), "refinement": "alternating"},
    "paper, pooled": {"isa": PooledFastICA(n_init=8), "refinement": "alternating"},
}

# All iterations amplify rounding errors on their way, those of ICA and ISA most, which
# stop at some distance from their limit: the results agree to less than rounding level.
# The joint refinement alone reaches 1e-9 for alpha and 1e-10 for the shapes.
ALPHA_TOLERANCE = 2e-5
SHAPE_TOLERANCE = 1e-6


def estimator(params, scale_frames=True):
    """Return an estimator. Many starts: test_default_strategies_are_invariant."""
    params = {"scale_frames": scale_frames, "random_state": 0} | params
    return OneStart(4, **params)


def faces(load_data, name):
    """Return the tracks of complete frames, a subset of a real table or synthetic."""
    if name == "synthetic":
        return make_face_tracks(120, n_components=4, random_state=1).tracks
    tracks = load_data(name)["W2d"].astype(float)
    tracks = tracks[~np.isnan(tracks).any(axis=(1, 2))]
    return tracks[:: len(tracks) // 200]


def rotations(angle):
    """Return rotations of the image, (..., 2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def angles(tracks, rng):
    return rng.uniform(0, 2 * np.pi, len(tracks))


CHANGES = {
    "frames moved": lambda tracks, rng: (
        tracks + rng.normal(0, 500, (len(tracks), 1, 2))
    ),
    "image turned": lambda tracks, rng: tracks @ rotations(1.0),
    "image mirrored": lambda tracks, rng: tracks * [-1, 1],
    "axes exchanged": lambda tracks, rng: tracks[:, :, ::-1],
    "frames turned": lambda tracks, rng: tracks @ rotations(angles(tracks, rng)),
    "tiny unit": lambda tracks, rng: tracks * 1e-9,
    "huge unit": lambda tracks, rng: tracks * 1e9,
    "one frame rescaled": lambda tracks, rng: (
        tracks * np.where(np.arange(len(tracks)) == 17, 0.01, 1.0)[:, None, None]
    ),
    "frames rescaled": lambda tracks, rng: (
        tracks * np.exp(rng.normal(size=(len(tracks), 1, 1)))
    ),
}


@pytest.fixture(
    scope="module", params=slow_after(1, ["synthetic", "ict_bu3dfe_like_68"])
)
def tracks(request, load_data):
    return faces(load_data, request.param)


@pytest.fixture(scope="module", params=slow_after(2, VARIANTS))
def variant(request):
    return VARIANTS[request.param]


@pytest.fixture(scope="module")
def models(tracks, variant):
    """Return the fits of frames that are scaled, and of those that are not."""
    X = table_of(tracks)
    return {scaled: estimator(variant, scaled).fit(X) for scaled in (True, False)}


def all_shapes(model):
    """Return mean and basis shapes, (K + 1, J, 3)."""
    return np.concatenate([model.mean_shape_[None], model.basis_])


def assert_shapes_agree(shapes, expected):
    """Compare shapes up to one orthogonal transform of space."""
    U, _, Vt = np.linalg.svd(shapes.reshape(-1, 3).T @ expected.reshape(-1, 3))
    tolerance = SHAPE_TOLERANCE * np.abs(expected).max()
    assert_allclose(shapes @ U @ Vt, expected, atol=tolerance, rtol=0)


def assert_models_agree(model, expected):
    assert_allclose(model.alpha_, expected.alpha_, atol=ALPHA_TOLERANCE, rtol=0)
    assert_shapes_agree(all_shapes(model), all_shapes(expected))
    assert_allclose(model.inverse_snr_, expected.inverse_snr_, rtol=1e-6)
    if model.refinement == "joint":
        found, wanted = (m.diagnostics().weak_deviations for m in (model, expected))
        assert_allclose(found, wanted, rtol=1e-4)


# --- invariances --------------------------------------------------------------------


def with_changes(tracks, *names):
    """Return the tracks with changes, one after the other."""
    rng = np.random.default_rng(0)
    for name in names:
        tracks = CHANGES[name](tracks, rng)
    return tracks


# Several at once where nothing can hide: none undoes what another does.
@pytest.mark.parametrize(
    ("scale_frames", "changes"),
    [
        (True, ("image mirrored", "frames moved", "huge unit")),
        (True, ("axes exchanged", "frames turned", "one frame rescaled", "tiny unit")),
        (False, ("frames moved", "frames turned", "tiny unit")),
    ],
    ids=str,
)
def test_coefficients_do_not_depend_on_placement(
    tracks, models, variant, scale_frames, changes
):
    changed, model = table_of(with_changes(tracks, *changes)), models[scale_frames]
    assert_models_agree(estimator(variant, scale_frames).fit(changed), model)
    if scale_frames:
        # The model of the first table gives the coefficients of the second one.
        assert_allclose(model.transform(changed), model.alpha_, atol=1e-9)


@may_not_converge
@pytest.mark.parametrize("refinement", slow_after(1, ["joint", "alternating"]))
@pytest.mark.parametrize(
    ("name", "n_components"),
    slow_after(1, [("missing", 2), ("muct_68", 4), ("ict_bu3dfe_like_68", 9)]),
)
def test_default_strategies_are_invariant(load_data, name, n_components, refinement):
    if name == "missing":
        options = {"noise": 0.02, "missing": 0.2, "random_state": 0}
        original = make_nonrigid_tracks(100, 30, n_components=2, **options).tracks
    else:
        original = faces(load_data, name)
    changed = with_changes(original, "frames moved", "frames turned", "frames rescaled")
    rng = np.random.default_rng(0)
    frames, points = (rng.permutation(n) for n in original.shape[:2])
    model = AffineNRSfM(n_components, refinement=refinement, random_state=0)
    tables = map(table_of, (original, changed[frames][:, points]))
    first, other = (clone(model).fit(table) for table in tables)
    assert_allclose(other.alpha_, first.alpha_[frames], atol=ALPHA_TOLERANCE, rtol=0)
    assert_shapes_agree(all_shapes(other), all_shapes(first)[:, points])


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["cauchy", "huber"])
def test_robust_fits_are_invariant(loss):
    # The weights stop changing at some distance from their limit.
    options = {"noise": 0.02, "random_state": 0}
    original = make_nonrigid_tracks(80, 25, n_components=2, **options).tracks
    original[:, 3] += np.where(np.arange(80) % 9 == 0, 1.0, 0.0)[:, None]
    first = AffineNRSfM(2, loss=loss, random_state=0).fit(table_of(original))
    for changes in (
        ("frames moved", "image turned"),
        ("frames turned", "frames rescaled"),
    ):
        changed = table_of(with_changes(original, *changes))
        for alpha in (clone(first).fit(changed).alpha_, first.transform(changed)):
            assert_allclose(alpha, first.alpha_, atol=1e-4, rtol=0)


# --- gauge --------------------------------------------------------------------------


def centred_frames(tracks):
    """Return the frames, centred, and their sizes (n_frames, 1, 1)."""
    centred = tracks - tracks.mean(axis=1, keepdims=True)
    return centred, np.std(centred, axis=(1, 2), keepdims=True)


@pytest.mark.parametrize("scale_frames", [True, False])
def test_x_and_y_are_the_axes_of_the_mean_camera(tracks, models, scale_frames):
    fitted, (centred, sizes) = models[scale_frames], centred_frames(tracks)
    mean = np.mean(fitted.motion_ / (sizes if scale_frames else 1.0), axis=0)
    mean /= np.abs(mean).max()
    assert_allclose(mean[:, 2], 0, atol=1e-10)
    assert_allclose(mean[:, :2], mean[:, :2].T, atol=1e-10)
    assert np.linalg.eigvalsh(mean[:, :2])[0] > 0.2
    # Right and down in the mean image are right and down in the mean shape.
    image = np.mean(centred / sizes, axis=0)
    for axis in (0, 1):
        assert np.corrcoef(image[:, axis], fitted.mean_shape_[:, axis])[0, 1] > 0.95


def test_axes_are_principal_axes_where_cameras_have_no_common_view(rng):
    # Cameras that look from everywhere, frames at any angle: their mean is nothing.
    made = make_nonrigid_tracks(200, 30, n_components=2, noise=0.01, random_state=0)
    turned = made.tracks @ rotations(angles(made.tracks, rng))
    for scale_frames in (True, False):
        options = {"isa": FastISA(n_init=2), "scale_frames": scale_frames}
        fitted = OneStart(2, **options, random_state=0).fit(table_of(turned))
        _, sizes = centred_frames(turned)
        motion = fitted.motion_ / (sizes if scale_frames else 1.0)
        mean = np.linalg.svd(motion.mean(axis=0), compute_uv=False)
        assert mean[1] < 0.2 * np.sqrt(np.mean(np.sum(motion**2, axis=(1, 2))) / 2)
        second = np.mean(np.swapaxes(motion, 1, 2) @ motion, axis=0)
        assert_allclose(second, np.diag(np.diag(second)), atol=1e-9 * second.max())
        assert np.all(np.diff(np.diag(second)) < 0)
        assert np.all(np.mean(fitted.mean_shape_**3, axis=0) > 0)
        # The reference camera looks along the third axis.
        reference = fitted.reference_motion_
        assert_allclose(reference[:, 2], 0)
        assert_allclose(reference[[0, 1], [1, 0]], 0)
        assert np.all(reference[[0, 1], [0, 1]] > 0)
