"""The independent basis among all bases that fit a table equally well.

A fit determines the shapes of the frames, up to one affinity of space and one scale a
frame. It does not determine their basis. Three replacements fit equally well:

- B_0 by ``B_0 + sum_k u_k B_k``, fixed by coefficients with mean zero;
- B_k by ``B_k + v_k B_0``, which the scales of the cameras absorb, fixed by basis
  shapes without a part along the mean shape;
- any invertible mixing of the basis shapes, fixed by independence. This is the
  assumption of Brandt, Ackermann, Grasshof (2018), but with one mixing for all three
  coordinates.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.models import FrameMap
from isa_nrsfm._gauge.canonical import (
    Gauge,
    canonical_gauge,
    canonical_space,
    euclidean_space,
)
from isa_nrsfm._linalg.rounding import OF_DIFFERENCES, OF_RANKS
from isa_nrsfm.isa._shared_mixing import independent_coefficients, shared_mixing


def independent_gauge(
    shapes: NDArray,
    motion: NDArray,
    alpha: NDArray,
    independence: str | None,
    camera: str = "affine",
    unit: float | None = None,
) -> tuple[Gauge, FrameMap]:
    """Return the independent basis of a fit as a gauge, and the map of frames to it.

    Shapes (K + 1, 3, J) are centred. Cameras (I, 2, 3) belong to frames of size one.
    "shapes" makes basis shapes independent over the points, "coefficients" makes
    coefficients independent over the frames. None takes the principal axes. `unit` is
    the size in `euclidean_space`.
    """
    # The shifts u and v, then the affinity of space.
    shift, motion, alpha = _centred(shapes, motion, alpha, camera)
    shapes = np.tensordot(shift, shapes, 1)
    space = canonical_space(shapes[0].T, motion)
    white = shapes[1:].mT @ space.T
    if camera != "affine":
        space = euclidean_space(shapes[0].T, motion, unit)
    # The mixing of the basis shapes, then their order, scale and signs.
    mixing: NDArray
    if independence == "shapes":
        mixing = shared_mixing(white)
    elif independence == "coefficients":
        mixing = np.linalg.inv(independent_coefficients(alpha)).T
    else:
        mixing = _principal_axes(white, alpha)
    basis = np.tensordot(mixing, shapes[1:], 1).mT
    unmixing = np.linalg.inv(mixing).T
    gauge = canonical_gauge(shapes[0].T, basis, motion, alpha @ unmixing.T, space)
    # Coefficients (1, alpha_i) change by the inverse transpose of the mixing of shapes.
    factors = gauge.factors
    scale = np.divide(1.0, factors, where=factors != 0, out=np.zeros_like(factors))
    coefficients = np.linalg.inv(shift).T
    coefficients[1:] = scale[:, None] * (unmixing @ coefficients[1:])[gauge.order]
    return gauge, FrameMap(coefficients, space)


def _centred(
    shapes: NDArray, motion: NDArray, alpha: NDArray, camera: str
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the shifts u and v as a matrix (n, n), the new cameras and coefficients.

    ``B_0 + sum_k u_k B_k`` gives the coefficients mean zero. ``B_k + v_k B_0`` makes
    the basis shapes orthogonal to the mean shape: ``<T B_k, T B_0> = 0`` where T
    whitens B_0, that is ``tr(B_k B_0^+) = 0``. With weak-perspective cameras it is
    ``<B_k, B_0> = 0``. Each shift slightly undoes the other, so they alternate.

    Then ``1 - sum_k v_k alpha_ik`` is the factor of the scale of frame i. v is zero if
    any such factor is not positive or too small, or if the alternation does not
    converge. It is zero for orthographic cameras, whose scale is fixed.
    """
    rank = max(np.linalg.matrix_rank(shapes[0], rtol=OF_RANKS), 1)
    first = total = _mean_shift(alpha)
    moved, scale = alpha - first[0, 1:], np.ones(len(alpha))
    for _ in range(0 if camera == "orthographic" else 200):
        # v, from the current shapes: <B_k, dual> is the part of B_k along B_0.
        current = np.tensordot(total, shapes, 1)
        if camera == "affine":
            dual = np.linalg.pinv(current[0], rcond=OF_RANKS).T / rank
        else:
            dual = current[0] / (np.vdot(current[0], current[0]) or 1.0)
        along = np.eye(len(shapes))
        along[1:, 0] = -np.einsum("kcj,cj->k", current[1:], dual)
        # Scales of the frames absorb it, and coefficients follow.
        factor = 1 - moved @ along[1:, 0]
        if not (factor > 0).all():
            break
        scale = scale * factor
        moved = moved / factor[:, None]
        # u, from the new coefficients.
        mean = _mean_shift(moved)
        moved = moved - mean[0, 1:]
        total = mean @ along @ total
        change = np.abs(mean[0, 1:]) + np.abs(along[1:, 0])
        rounding = OF_DIFFERENCES * max(1.0, np.abs(moved).max())
        if np.max(change, initial=0.0) <= rounding:
            if scale.min() < 0.1 * scale.mean():
                break
            return total, motion * scale[:, None, None], moved
    return first, motion, alpha - first[0, 1:]


def _mean_shift(alpha: NDArray) -> NDArray:
    """Return the mixing (n, n) that adds the mean of alpha (n_frames, n - 1) to B_0."""
    mixing = np.eye(alpha.shape[1] + 1)
    mixing[0, 1:] = alpha.mean(axis=0)
    return mixing


def _principal_axes(basis: NDArray, alpha: NDArray) -> NDArray:
    """Return the mixing (K, K) to uncorrelated coefficients and orthogonal shapes."""
    variance, axes = np.linalg.eigh(alpha.T @ alpha / len(alpha))
    variance[variance <= OF_RANKS**2 * max(variance[-1], 1e-300)] = 1.0
    root = (axes * np.sqrt(variance)) @ axes.T
    flat = root @ basis.reshape(len(basis), -1)
    directions: NDArray = np.linalg.eigh(flat @ flat.T)[1]
    return directions[:, ::-1].T @ root
