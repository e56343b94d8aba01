"""The methods that are compared, and what each of them finds in a table."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse.linalg import svds
from sklearn.base import BaseEstimator

from benchmarks._sets import as_table, measurement_matrix, rotations_and_scales
from isa_nrsfm import AffineNRSfM, FastISA, baselines
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

    def in_camera(self, scaled=True):
        """Return the Euclidean shapes in the axes of the cameras."""
        shapes = self.euclidean @ self.rotations.transpose(0, 2, 1)
        return self.scales[:, None, None] * shapes if scaled else shapes


class Method(NamedTuple):
    """
    A method of the comparison.

    Attributes
    ----------
    title : str
        What it is called in tables and figures.
    make : callable
        Returns the estimator for a `Set`, a number of basis shapes and a seed.
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
        W, sizes = measurement_matrix(X, self.scale_frames)
        V = svds(W, self.rank, random_state=0)[2].T
        self.motion_ = sizes * (W @ V).reshape(len(X), 2, -1)
        self.mean_shape_ = V
        images = V @ self.motion_.transpose(0, 2, 1)
        centroids = X.reshape(len(X), -1, 2).mean(axis=1, keepdims=True)
        self.X_ = as_table(images + centroids)
        return self


def ours(kind, n_components, seed, **parameters):
    """Return our estimator; it takes no notice of the order of frames."""
    scaled = kind.case.scale_frames
    return AffineNRSfM(
        n_components, scale_frames=scaled, random_state=seed, **parameters
    )


def theirs(name, kind, n_components, seed):
    """Return a baseline by the name of its class."""
    model = getattr(baselines, name)(n_components)
    known = {"scale_frames": kind.case.scale_frames, "ordered": kind.ordered}
    known["random_state"] = seed
    return model.set_params(**{k: known[k] for k in known if k in model.get_params()})


def rigid(kind, n_components, seed):
    """Return the rigid factorisation."""
    return TruncatedTable(3, kind.case.scale_frames)


def floor(kind, n_components, seed):
    """Return the best table of the rank that the model can have."""
    return TruncatedTable(3 * n_components + 3, kind.case.scale_frames)


def images_of(model, shapes):
    """Return the table of shapes that the cameras of a model see."""
    images = shapes @ model.motion_.transpose(0, 2, 1)
    return as_table(images + model.translation_[:, None])


def found_by_ours(model, X):
    """Return what AffineNRSfM has found in its table, with all directions of shapes."""
    shapes, images = model.reconstruct(X), model.reproject(X)
    if model.camera != "affine":
        cameras = rotations_and_scales(model.decompose(X).motion)
        return Found(images, shapes, shapes, *cameras)
    metric = deformation_metric(model.motion_, model.alpha_)
    euclidean = euclidean_frames(
        metric, model.motion_, model.alpha_, model.mean_shape_, model.basis_
    )
    return Found(images, shapes, *euclidean)


def found_by_baseline(model, X):
    """Return what a baseline has found in its table: its own shapes and cameras."""
    cameras = rotations_and_scales(model.motion_)
    return Found(
        images_of(model, model.shapes_), model.shapes_, model.shapes_, *cameras
    )


def found_by_rigid(model, X):
    """Return the rigid shape of all frames."""
    upgrade = metric_upgrade(model.motion_)
    shape = euclidean_shapes(model.mean_shape_, upgrade.Q)
    shapes = np.broadcast_to(shape, (len(X), *shape.shape))
    return Found(model.X_, shapes, shapes, upgrade.rotations, upgrade.scales)


def our_method(title, **parameters):
    """Return the method of our estimator with some parameters."""
    return Method(title, partial(ours, **parameters), found_by_ours, True)


PAPERS = {"refinement": "alternating"}
WEAK = {"camera": "weak_perspective"}
METHODS = {
    "floor": Method("rank floor", floor, lambda model, X: Found(model.X_)),
    "rigid": Method("rigid mean shape", rigid, found_by_rigid),
    "pi": Method("PI", partial(theirs, "PseudoInverseNRSfM"), found_by_baseline),
    "bmm": Method("BMM", partial(theirs, "BlockMatrixNRSfM"), found_by_baseline),
    "kong_lucey": Method(
        "Kong-Lucey", partial(theirs, "CompressibleNRSfM"), found_by_baseline, True
    ),
    "isa1": our_method("ISA1, paper's refinement", isa=FastISA(), **PAPERS),
    "isa2": our_method("ISA2, paper's refinement", **PAPERS),
    "joint": our_method("ISA, joint refinement"),
    "weak_perspective": our_method("ISA, weak perspective", **WEAK),
    "orthographic": our_method("ISA, orthographic", camera="orthographic"),
    "consensus": our_method("ISA, consensus", refinement="consensus", **WEAK),
}
# Those that know something of the cameras.
CALIBRATED = ("weak_perspective", "orthographic", "consensus")
METHOD_TITLES = {name: method.title for name, method in METHODS.items()}
