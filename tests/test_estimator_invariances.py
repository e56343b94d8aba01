"""What the coefficients do not depend on, and the gauge of the shapes."""

import numpy as np
import pytest
from layers import OneStart, may_not_converge, slow_after
from made_once import made_once
from numpy.testing import assert_allclose
from scenes import table_of
from sklearn.base import clone

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks

# The warning about the layout has tests of its own.
pytestmark = [
    pytest.mark.filterwarnings("ignore:layout=:UserWarning"),
    may_not_converge,
]

VARIANTS = {
    "joint": {},
    "paper, fast": {"isa": FastISA(n_init=4), "refinement": "alternating"},
    "paper, pooled": {"isa": PooledFastICA(n_init=8), "refinement": "alternating"},
}
TRACKS = make_face_tracks(80, n_components=3, random_state=1).tracks

# All iterations amplify rounding errors on their way, those of ICA and ISA most, which
# stop at some distance from their limit: the results agree to less than rounding level.
# The joint refinement alone reaches 1e-9 for alpha and 1e-10 for the shapes.
ALPHA_TOLERANCE = 2e-5
SHAPE_TOLERANCE = 1e-6


def estimator(variant, scale_frames):
    """Return an estimator. Many starts: test_default_strategies_are_invariant."""
    options = {"scale_frames": scale_frames, "random_state": 0}
    return OneStart(3, **options, **VARIANTS[variant])


@made_once
def fitted(variant="joint", scale_frames=True):
    """Return a model of the tracks, to be left as it is."""
    return estimator(variant, scale_frames).fit(table_of(TRACKS))


def rotations(angle):
    """Return rotations of the image, (..., 2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def turned(tracks, rng):
    """Return the tracks, each frame turned by an angle of its own."""
    return tracks @ rotations(rng.uniform(0, 2 * np.pi, len(tracks)))


def times(tracks, factors):
    """Return the tracks, each frame times a factor of its own."""
    return tracks * factors[:, None, None]


CHANGES = {
    "frames moved": lambda X, rng: X + rng.normal(0, 500, (len(X), 1, 2)),
    "image mirrored": lambda X, rng: X * [-1, 1],
    "axes exchanged": lambda X, rng: X[:, :, ::-1],
    "frames turned": turned,
    "tiny unit": lambda X, rng: X * 1e-9,
    "huge unit": lambda X, rng: X * 1e9,
    "one frame rescaled": lambda X, rng: times(X, 0.01 ** (np.arange(len(X)) == 17)),
    "frames rescaled": lambda X, rng: times(X, np.exp(rng.normal(size=len(X)))),
}


def all_shapes(model):
    """Return mean and basis shapes, (K + 1, J, 3)."""
    return np.concatenate([model.mean_shape_[None], model.basis_])


def assert_shapes_agree(shapes, expected):
    """Compare shapes up to one orthogonal transform of space."""
    U, _, Vt = np.linalg.svd(shapes.reshape(-1, 3).T @ expected.reshape(-1, 3))
    tolerance = SHAPE_TOLERANCE * np.abs(expected).max()
    assert_allclose(shapes @ U @ Vt, expected, atol=tolerance, rtol=0)


# --- invariances --------------------------------------------------------------------


def with_changes(tracks, *names):
    """Return the tracks with changes, one after the other."""
    rng = np.random.default_rng(0)
    for name in names:
        tracks = CHANGES[name](tracks, rng)
    return tracks


# Several at once where nothing can hide: none undoes what another does.
@pytest.mark.parametrize("variant", slow_after(2, VARIANTS))
@pytest.mark.parametrize(
    ("scale_frames", "changes"),
    [
        (True, ("image mirrored", "frames moved", "huge unit")),
        (True, ("axes exchanged", "frames turned", "one frame rescaled", "tiny unit")),
        (False, ("frames moved", "frames turned", "tiny unit")),
    ],
    ids=str,
)
def test_coefficients_do_not_depend_on_placement(variant, scale_frames, changes):
    changed = table_of(with_changes(TRACKS, *changes))
    expected = fitted(variant, scale_frames)
    model = estimator(variant, scale_frames).fit(changed)
    assert_allclose(model.alpha_, expected.alpha_, atol=ALPHA_TOLERANCE, rtol=0)
    assert_shapes_agree(all_shapes(model), all_shapes(expected))
    assert_allclose(model.inverse_snr_, expected.inverse_snr_, rtol=1e-6)
    if variant == "joint":
        found, wanted = (m.diagnostics().weak_deviations for m in (model, expected))
        assert_allclose(found, wanted, rtol=1e-4)
    if scale_frames:
        # The model of the first table gives the coefficients of the second one.
        assert_allclose(expected.transform(changed), expected.alpha_, atol=1e-9)


@pytest.mark.parametrize("refinement", slow_after(1, ["joint", "alternating"]))
def test_default_strategies_are_invariant(refinement):
    options = {"noise": 0.02, "missing": 0.2, "random_state": 0}
    original = make_nonrigid_tracks(60, 30, n_components=2, **options).tracks
    changed = with_changes(original, "frames moved", "frames turned", "frames rescaled")
    rng = np.random.default_rng(0)
    frames, points = (rng.permutation(n) for n in original.shape[:2])
    model = AffineNRSfM(2, refinement=refinement, random_state=0)
    tables = map(table_of, (original, changed[frames][:, points]))
    first, other = (clone(model).fit(table) for table in tables)
    assert_allclose(other.alpha_, first.alpha_[frames], atol=ALPHA_TOLERANCE, rtol=0)
    assert_shapes_agree(all_shapes(other), all_shapes(first)[:, points])


# --- gauge --------------------------------------------------------------------------


def centred_frames(tracks):
    """Return the frames, centred, and their sizes (n_frames, 1, 1)."""
    centred = tracks - tracks.mean(axis=1, keepdims=True)
    return centred, np.std(centred, axis=(1, 2), keepdims=True)


@pytest.mark.parametrize("variant", ["joint", "paper, fast"])
@pytest.mark.parametrize("scale_frames", [True, False])
def test_x_and_y_are_the_axes_of_the_mean_camera(variant, scale_frames):
    model, (centred, sizes) = fitted(variant, scale_frames), centred_frames(TRACKS)
    mean = np.mean(model.motion_ / (sizes if scale_frames else 1.0), axis=0)
    mean /= np.abs(mean).max()
    assert_allclose(mean[:, 2], 0, atol=1e-10)
    assert_allclose(mean[:, :2], mean[:, :2].T, atol=1e-10)
    assert np.linalg.eigvalsh(mean[:, :2])[0] > 0.2
    # Right and down in the mean image are right and down in the mean shape.
    image = np.mean(centred / sizes, axis=0)
    for axis in (0, 1):
        assert np.corrcoef(image[:, axis], model.mean_shape_[:, axis])[0, 1] > 0.95


@pytest.mark.parametrize("scale_frames", [True, False])
def test_axes_are_principal_axes_where_cameras_have_no_common_view(scale_frames, rng):
    # Cameras that look from everywhere, frames at any angle: their mean is nothing.
    made = make_nonrigid_tracks(200, 30, n_components=2, noise=0.01, random_state=0)
    tracks = turned(made.tracks, rng)
    options = {"isa": FastISA(n_init=2), "scale_frames": scale_frames}
    model = OneStart(2, **options, random_state=0).fit(table_of(tracks))
    _, sizes = centred_frames(tracks)
    motion = model.motion_ / (sizes if scale_frames else 1.0)
    mean = np.linalg.svd(motion.mean(axis=0), compute_uv=False)
    assert mean[1] < 0.2 * np.sqrt(np.mean(np.sum(motion**2, axis=(1, 2))) / 2)
    second = np.mean(motion.mT @ motion, axis=0)
    assert_allclose(second, np.diag(np.diag(second)), atol=1e-9 * second.max())
    assert np.all(np.diff(np.diag(second)) < 0)
    assert np.all(np.mean(model.mean_shape_**3, axis=0) > 0)
    # The reference camera looks along the third axis.
    reference = model.reference_motion_
    assert_allclose(reference[:, 2], 0)
    assert_allclose(reference[[0, 1], [1, 0]], 0)
    assert np.all(reference[[0, 1], [0, 1]] > 0)
