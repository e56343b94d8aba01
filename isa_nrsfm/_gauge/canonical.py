"""The canonical choice among shapes and cameras that fit a table equally well.

An affinity of space (with calibrated cameras a rotation) and the order, scale and sign
of the basis shapes are free. Here they are fixed. The sign of depth is a convention: a
table does not distinguish an object from its mirror image.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import mean_view
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.small_matrices import orientations


class Gauge(NamedTuple):
    """Canonical shapes."""

    mean_shape: NDArray  # (n_points, 3), in the canonical space
    basis: NDArray  # (n_components, n_points, 3), in canonical order and scale
    order: NDArray  # (n_components,), index of each basis shape in the given basis
    factors: NDArray  # (n_components,), their factors, zero for those without motion


def canonical_rotation(mean_shape: NDArray, cameras: NDArray) -> NDArray:
    """Return the orthogonal A (3, 3) with which ``S A^T`` and ``M A^T`` are frontal.

    The x and y axes are the orthonormal pair nearest to the rows of the mean camera. If
    cameras (I, 2, 3) have no common view, the axes are the principal ones of ``sum_i
    M_i^T M_i``. The depth of the mean shape (J, 3) has non-negative skewness.
    """
    view = mean_view(cameras)
    if view is None:
        rows = cameras.reshape(-1, 3)
        axes = np.linalg.eigh(rows.T @ rows)[1][:, ::-1].T
        return axes * orientations(axes @ mean_shape.T)[:, None]
    U, _, Vt = np.linalg.svd(view, full_matrices=False)
    across = U @ Vt
    axes = np.vstack([across, np.cross(*across)])
    axes[2] *= orientations(axes[2:] @ mean_shape.T)[0]
    return axes


def canonical_space(mean_shape: NDArray, motion: NDArray) -> NDArray:
    """Return the affinity A (3, 3) of space that makes the mean shape (J, 3) white.

    Shapes become ``B A^T`` and cameras (I, 2, 3) of frames of size one ``M A^-1``. The
    mean of ``b b^T`` over the points is the identity, with zeros along directions in
    which the shape is flat. The rotation is `canonical_rotation`.
    """
    variance, axes = np.linalg.eigh(mean_shape.T @ mean_shape / len(mean_shape))
    inside = variance > 1e-18 * variance[-1]
    # Directions in which the shape is flat get the scale of the widest direction.
    scale = 1.0 / np.sqrt(np.where(inside, variance, variance[-1] or 1.0))
    whitening = (axes * scale) @ axes.T
    white_motion = motion @ np.linalg.inv(whitening)
    return canonical_rotation(mean_shape @ whitening, white_motion) @ whitening


def euclidean_space(
    mean_shape: NDArray, motion: NDArray, size: float | None
) -> NDArray:
    """Return `canonical_rotation` times a size; None makes the shape's RMS one."""
    if size is None:
        size = 1.0 / (np.sqrt(np.mean(mean_shape**2)) or 1.0)
    return size * canonical_rotation(mean_shape, motion)


def canonical_gauge(
    mean_shape: NDArray, basis: NDArray, motion: NDArray, alpha: NDArray, space: NDArray
) -> Gauge:
    """Return the canonical shapes among those that fit equally well, in a space (3, 3).

    The basis is sorted by decreasing energy in the images, ``sum_i ||alpha_ik M_i
    B_k||_F^2``, with cameras (I, 2, 3) of frames of size one. Coefficients (I, K) get
    unit variance (mean square where they do not vary) and non-negative skewness. A
    basis shape without motion becomes zero.
    """
    energy = image_energies(motion, basis, alpha)
    order = np.argsort(-energy, kind="stable")
    rigid = image_energies(motion, mean_shape[None], np.ones((len(motion), 1)))
    # Basis shapes with less energy are rounding errors.
    moving = energy > OF_RANKS**2 * rigid
    factors = np.where(moving, orientations(alpha.T) * coefficient_sizes(alpha), 0.0)
    scaled = factors[:, None, None] * basis
    return Gauge(mean_shape @ space.T, scaled[order] @ space.T, order, factors[order])


def rigid_gauge(
    mean_shape: NDArray,
    basis: NDArray,
    sizes: NDArray,
    fitted: Callable[[NDArray, NDArray], Decomposition],
    *,
    camera: str,
    dtype: Any,
) -> tuple[Gauge, Decomposition]:
    """Return the gauge of the paper's pipeline, and the fit of the frames in it.

    The gauge is that of a fit to visible points, not to completed frames. `fitted`
    returns the fit for a mean shape (J, 3) and a basis (K, J, 3), rounded to a dtype.
    """
    order, frames = np.arange(len(basis)), fitted(mean_shape, basis)
    # One scaling is enough, unless frames have fewer points than coefficients need.
    for _ in range(50):
        motion = frames.motion / sizes[:, None, None]
        if camera == "affine":
            space = canonical_space(mean_shape, motion)
        else:
            size = 1.0 if camera == "orthographic" else None
            space = euclidean_space(mean_shape, motion, size)
        gauge = canonical_gauge(mean_shape, basis, motion, frames.alpha, space)
        order = order[gauge.order]
        mean_shape, basis = gauge.mean_shape.astype(dtype), gauge.basis.astype(dtype)
        frames = fitted(mean_shape, basis)
        # Coefficients scale with the basis shapes. If a frame does not determine its
        # coefficients, their solution of minimum norm changes.
        off = coefficient_sizes(frames.alpha)[basis.any(axis=(1, 2))] - 1
        if np.abs(off).max(initial=0.0) <= 1e-6:
            break
    return Gauge(mean_shape, basis, order, gauge.factors), frames


def coefficient_sizes(alpha: NDArray) -> NDArray:
    """Return standard deviations (K,) of alpha (I, K), or RMS where they are zero."""
    deviation = alpha.std(axis=0)
    constant = deviation <= 1e-12 * np.abs(alpha).max(axis=0)
    return np.where(constant, np.sqrt(np.mean(alpha**2, axis=0)), deviation)


def image_energies(motion: NDArray, basis: NDArray, alpha: NDArray) -> NDArray:
    """Return ``sum_i ||alpha_ik M_i B_k||^2`` (K,) of basis shapes (K, J, 3)."""
    cameras = motion.mT @ motion
    weighted = np.tensordot(alpha**2, cameras, axes=(0, 0))
    return np.einsum("kab,kab->k", weighted, basis.mT @ basis)


def mode_covariance(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return the mode covariance matrix of cameras (I, 2, 3) and coefficients (I, K).

    ``(1 / 2I) sum_i (alpha_i alpha_i^T) (x) (M_i^T M_i)``, of shape (3K, 3K), is the
    covariance over the images of Brandt et al. (2018), section 3.3.
    """
    total = np.zeros((3 * alpha.shape[1],) * 2)
    for start in range(0, len(alpha), 4096):  # blocks limit memory
        part = slice(start, start + 4096)
        blocks = np.einsum("ik,irc->irkc", alpha[part], motion[part])
        blocks = blocks.reshape(-1, len(total))
        total += blocks.T @ blocks
    return total / (2 * len(alpha))


def reorder_blocks(matrix: NDArray, order: NDArray) -> NDArray:
    """Return a matrix of 3x3 blocks with its rows and columns of blocks in an order."""
    index = (3 * order[:, None] + np.arange(3)).ravel()
    return matrix[np.ix_(index, index)]
