"""The methods that are compared, and what each of them finds in a table."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import BaseEstimator

from isa_nrsfm import AffineNRSfM, FastISA, baselines
from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm._metric_upgrade.rigid import nearest_rotations
from isa_nrsfm._paper.factors import leading_triplets
from isa_nrsfm._tables.tracks import (
    centred_tracks,
    measurement_matrix,
    table_to_tracks,
    tracks_to_table,
    weighting_sizes,
)
from isa_nrsfm.calibration import (
    deformation_metric,
    euclidean_frames,
    euclidean_shapes,
    metric_upgrade,
)


class Found(NamedTuple):
    """
    What a method says of the frames of a table.

    Attributes
    ----------
    X : ndarray of shape (n_frames, 2 * n_points)
        The table as the method has it.
    affine : ndarray of shape (n_frames, n_points, 3) or None
        Shapes in a space that may be stretched.
    euclidean : ndarray of shape (n_frames, n_points, 3) or None
        Shapes with true angles.
    rotations : ndarray of shape (n_frames, 3, 3) or None
        Of the cameras that see the Euclidean shapes.
    scales : ndarray of shape (n_frames,) or None
        Of these cameras.
    """

    X: np.ndarray
    affine: np.ndarray | None = None
    euclidean: np.ndarray | None = None
    rotations: np.ndarray | None = None
    scales: np.ndarray | None = None


class Method(NamedTuple):
    """
    A method of the comparison.

    Attributes
    ----------
    title : str
        What it is called in tables and figures.
    make : callable
        Returns the estimator for a number of basis shapes, whether frames are scaled,
        whether they are ordered, and a seed.
    found : callable
        Returns what the fitted estimator has found in its table.
    is_random : bool
        Whether the seed makes a difference.
    """

    title: str
    make: Callable[..., Any]
    found: Callable[[Any, np.ndarray], Found]
    is_random: bool = False


class TruncatedTable(BaseEstimator):
    """
    The table of a given rank that is nearest to a table.

    Parameters
    ----------
    rank : int
        The rank of the measurement matrix.
    scale_frames : bool
        Whether frames are scaled before.

    Attributes
    ----------
    X_ : ndarray of shape (n_frames, 2 * n_points)
        The nearest table.
    motion_ : ndarray of shape (n_frames, 2, rank)
        Its left factor.
    mean_shape_ : ndarray of shape (n_points, rank)
        Its right factor.
    """

    def __init__(self, rank, scale_frames):
        self.rank = rank
        self.scale_frames = scale_frames

    def fit(self, X, y=None):
        """Factorise a table."""
        centred, translation = centred_tracks(table_to_tracks(X))
        sizes = weighting_sizes(centred, self.scale_frames)[:, None, None]
        W = measurement_matrix(centred / sizes)
        V = leading_triplets(W, self.rank)[1].T
        self.motion_ = sizes * (W @ V).reshape(len(X), 2, -1)
        self.mean_shape_ = V
        images = V @ self.motion_.transpose(0, 2, 1)
        self.X_ = tracks_to_table(images + translation[:, None])
        return self


def ours(n_components, scale_frames, ordered, seed, **parameters):
    """Return our estimator; it takes no notice of the order of frames."""
    return AffineNRSfM(
        n_components, scale_frames=scale_frames, random_state=seed, **parameters
    )


def theirs(name, n_components, scale_frames, ordered, seed):
    """Return a baseline by the name of its class."""
    model = getattr(baselines, name)(n_components)
    known = {"scale_frames": scale_frames, "ordered": ordered, "random_state": seed}
    return model.set_params(**{k: known[k] for k in known if k in model.get_params()})


def rigid(n_components, scale_frames, ordered, seed):
    """Return the rigid factorisation."""
    return TruncatedTable(3, scale_frames)


def floor(n_components, scale_frames, ordered, seed):
    """Return the best table of the rank that the model can have."""
    return TruncatedTable(3 * n_components + 3, scale_frames)


def found_by_ours(model, X):
    """Return what AffineNRSfM has found in its table."""
    shapes = compose(model.mean_shape_, model.basis_, model.alpha_)
    images = tracks_to_table(project(shapes, model.motion_, model.translation_))
    if model.camera != "affine":
        return Found(images, shapes, shapes, model.rotations_, model.scales_)
    metric = deformation_metric(model.motion_, model.alpha_)
    frames = euclidean_frames(
        metric, model.motion_, model.alpha_, model.mean_shape_, model.basis_
    )
    return Found(images, shapes, *frames)


def found_by_baseline(model, X):
    """Return what a baseline has found in its table: its own shapes and cameras."""
    images = project(model.shapes_, model.motion_, model.translation_)
    scales = np.linalg.norm(model.motion_, axis=(1, 2)) / np.sqrt(2)
    X_found, shapes = tracks_to_table(images), model.shapes_
    return Found(X_found, shapes, shapes, nearest_rotations(model.motion_)[0], scales)


def found_by_rigid(model, X):
    """Return the rigid shape of all frames."""
    upgrade = metric_upgrade(model.motion_)
    shape = euclidean_shapes(model.mean_shape_, upgrade.Q)
    shapes = np.broadcast_to(shape, (len(X), *shape.shape))
    return Found(model.X_, shapes, shapes, upgrade.rotations, upgrade.scales)


METHODS = {
    "floor": Method("rank floor", floor, lambda model, X: Found(model.X_)),
    "rigid": Method("rigid mean shape", rigid, found_by_rigid),
    "pi": Method("PI", partial(theirs, "PseudoInverseNRSfM"), found_by_baseline),
    "bmm": Method("BMM", partial(theirs, "BlockMatrixNRSfM"), found_by_baseline),
    "kong_lucey": Method(
        "Kong-Lucey", partial(theirs, "CompressibleNRSfM"), found_by_baseline, True
    ),
    "isa1": Method(
        "ISA1, paper's refinement",
        partial(ours, refinement="alternating", isa=FastISA()),
        found_by_ours,
        True,
    ),
    "isa2": Method(
        "ISA2, paper's refinement",
        partial(ours, refinement="alternating"),
        found_by_ours,
        True,
    ),
    "joint": Method("ISA, joint refinement", ours, found_by_ours, True),
    "weak_perspective": Method(
        "ISA, weak perspective",
        partial(ours, camera="weak_perspective"),
        found_by_ours,
        True,
    ),
    "orthographic": Method(
        "ISA, orthographic", partial(ours, camera="orthographic"), found_by_ours, True
    ),
    "consensus": Method(
        "ISA, consensus",
        partial(ours, camera="weak_perspective", refinement="consensus"),
        found_by_ours,
        True,
    ),
}
# Those that know something of the cameras.
CALIBRATED = ("weak_perspective", "orthographic", "consensus")
METHOD_TITLES = {name: method.title for name, method in METHODS.items()}
