"""The canonical basis of the paper's pipeline, by the fit of the frames as they are."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._gauge.canonical import (
    canonical_gauge,
    canonical_space,
    coefficient_sizes,
    euclidean_space,
)

# Largest number of scalings of the basis shapes, and largest difference of the standard
# deviation of a coefficient from one. One scaling does, but where frames have fewer
# points than their coefficients need.
MAX_SCALINGS, UNIT_VARIANCE = 50, 1e-6


class RigidGauge(NamedTuple):
    """
    Canonical shapes, and the fit of the frames with them.

    Attributes
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes.
    order : ndarray of int, shape (n_components,)
        Index of each basis shape in the given basis.
    frames : Decomposition
        The fit.
    """

    mean_shape: NDArray
    basis: NDArray
    order: NDArray
    frames: Decomposition


def rigid_gauge(
    mean_shape: NDArray,
    basis: NDArray,
    sizes: NDArray,
    fitted: Callable[[NDArray, NDArray], Decomposition],
    *,
    camera: str,
    dtype: Any,
) -> RigidGauge:
    """
    Return the canonical shapes of the paper's pipeline.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        B_0, centred.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes.
    sizes : ndarray of shape (n_frames,)
        Sizes of the frames.
    fitted : callable
        Returns the fit of the frames for a mean shape and a basis.
    camera : {"affine", "weak_perspective", "orthographic"}
        What cameras are.
    dtype : dtype
        Type of the numbers that the shapes are rounded to.

    Returns
    -------
    RigidGauge
        The gauge of `canonical_gauge`, of the fit of the frames by the points that they
        show: with missing points it is not that of completed frames.
    """
    order, frames = np.arange(len(basis)), fitted(mean_shape, basis)
    for _ in range(MAX_SCALINGS):
        motion = frames.motion / sizes[:, None, None]
        if camera == "affine":
            space = canonical_space(mean_shape, motion)
        else:
            scale = 1.0 if camera == "orthographic" else None
            space = euclidean_space(mean_shape, motion, scale)
        gauge = canonical_gauge(mean_shape, basis, motion, frames.alpha, space)
        order = order[gauge.order]
        mean_shape, basis = gauge.mean_shape.astype(dtype), gauge.basis.astype(dtype)
        frames = fitted(mean_shape, basis)
        # Coefficients follow the scales of the basis shapes, but for frames that leave
        # some of them open: of these the solution of least norm is another one then.
        off = coefficient_sizes(frames.alpha)[basis.any(axis=(1, 2))] - 1
        if np.abs(off).max(initial=0.0) <= UNIT_VARIANCE:
            break
    return RigidGauge(mean_shape, basis, order, frames)
