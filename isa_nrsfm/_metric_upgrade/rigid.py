"""Metric upgrade: the affinity of space that makes affine cameras Euclidean ones."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.small_matrices import polar
from isa_nrsfm._metric_upgrade.metric import (
    CalibratedCamera,
    MetricFit,
    mean_gram,
    metric_quadric,
    refine_metric,
    safe_start,
    unit_cameras,
)

# Above this condition number the cameras hardly determine the metric. It is that of
# rotations by about five degrees.
LARGEST_CONDITION = 50.0


def usable_cameras(motion: ArrayLike, least: int = 1) -> tuple[NDArray, NDArray]:
    """Return cameras (I, 2, 3) and the mask of usable ones, at least `least`."""
    cameras = np.asarray(motion, dtype=np.float64)
    if cameras.ndim != 3 or cameras.shape[1:] != (2, 3) or len(cameras) < least:
        raise ValueError(
            f"motion must be of the shape (n_frames, 2, 3); got {cameras.shape}"
        )
    if np.isinf(cameras).any():
        raise ValueError(
            f"motion must not be infinite; {np.isinf(cameras).sum()} entries are"
        )
    usable = np.isfinite(cameras).all(axis=(1, 2)) & cameras.any(axis=(1, 2))
    return cameras, np.asarray(usable)


def fit_metric(cameras: NDArray, camera: CalibratedCamera) -> MetricFit:
    """Return the best metric of usable cameras (n_frames, 2, 3), from two starts."""
    eigenvalues = np.zeros(3)
    if len(cameras):
        gram = mean_gram(unit_cameras(cameras))
        eigenvalues = np.linalg.eigvalsh(gram)
    seen = eigenvalues > OF_RANKS * eigenvalues[-1]
    if not seen.all():
        raise ValueError(
            "a metric upgrade needs cameras that together see three directions of "
            f"space; the {len(cameras)} usable cameras see {seen.sum()}"
        )
    no_alpha, no_strain = np.zeros((len(cameras), 0)), np.zeros((0, 3, 3))
    fits = []
    for G in (np.linalg.inv(gram), metric_quadric(cameras)):
        if G is not None:
            Q = safe_start(cameras, G, camera)
            fits.append(refine_metric(cameras, no_alpha, (Q, no_strain), camera))
    return min(fits, key=lambda fit: fit.cost)


def best_metric(motion: NDArray) -> NDArray:
    """Return Q (3, 3) with which cameras (n, 2, 3) are most nearly scaled rotations.

    The identity if they do not see three directions of space.
    """
    cameras, usable = usable_cameras(motion)
    try:
        fit = fit_metric(cameras[usable], "weak_perspective")
    except ValueError:
        return np.eye(3)
    return symmetric_upgrade(fit.Q, cameras[usable])[1]


def symmetric_upgrade(Q: NDArray, cameras: NDArray) -> tuple[NDArray, NDArray]:
    """Return the orthogonal O and the symmetric S of ``Q = S O``, S (3, 3) scaled.

    The scales of the upgraded cameras (I, 2, 3) have mean square one.
    """
    turn, Q = linalg.polar(Q, side="left")
    # A scale is s = (s1 + s2) / 2 with the singular values of a camera. Then
    # s^2 = (s1^2 + s2^2) / 4 + s1 s2 / 2, and s1 s2 is the area that the rows span.
    rows = cameras @ Q
    area = np.linalg.norm(np.cross(rows[:, 0], rows[:, 1]), axis=1)
    return turn, Q / np.sqrt((np.sum(rows**2) / 4 + np.sum(area) / 2) / len(rows))


def nearest_rotations(cameras: NDArray) -> tuple[NDArray, NDArray]:
    """Return rotations (I, 3, 3) and stretches P (I, 2, 2): cameras are ``P R[:2]``."""
    rows, values, axes = polar(cameras)
    depth = np.cross(rows[:, 0], rows[:, 1])
    stretches = (axes * values[:, None]) @ axes.mT
    return np.concatenate([rows, depth[:, None]], axis=1), stretches


def warn_if_degenerate(condition_number: float) -> None:
    """Warn if the cameras hardly determine the metric."""
    if condition_number > LARGEST_CONDITION:
        warn_caller(
            f"the cameras hardly determine the metric of space: its condition number "
            f"is {condition_number:.3g}, above {LARGEST_CONDITION:g}. Euclidean shapes "
            "may have wrong depth and angles. Take frames that are seen from more "
            "sides, or more frames, or affine shapes"
        )
