"""The canonical choice among shapes and cameras that fit a table equally well.

An affinity of space (with calibrated cameras a rotation) and the order, scale and sign
of the basis shapes are free. Here they are fixed. The sign of depth is fixed by a
convention only: a table does not tell an object from its mirror image.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera import mean_view
from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.vectors import orientations

# Frames that are taken together where much is computed of each.
BLOCK_FRAMES = 4096


def canonical_rotation(mean_shape: NDArray, cameras: NDArray) -> NDArray:
    """
    Return the rotation or reflection of space that shows the mean shape from front.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape, centred.
    cameras : ndarray of shape (n_frames, 2, 3)
        Cameras.

    Returns
    -------
    ndarray of shape (3, 3)
        Orthogonal matrix A such that shapes ``S A^T`` and cameras ``M A^T`` are
        canonical. The x and y axes are the orthonormal pair nearest to the rows of the
        mean camera. Where the cameras have no common view, x, y and z are the principal
        axes of ``sum_i M_i^T M_i``. The third moment of depth is not negative.
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
    """
    Return the affinity of space that makes the mean shape white and seen from front.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        B_0, centred.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, each divided by the size of its frame.

    Returns
    -------
    ndarray of shape (3, 3)
        A such that shapes ``B A^T`` and cameras ``M A^-1`` are canonical. The mean of
        ``b b^T`` over the points of the mean shape is the identity (with zeros along
        directions in which it is flat). In that white space A is the rotation or
        reflection of `canonical_rotation`.
    """
    variance, axes = np.linalg.eigh(mean_shape.T @ mean_shape / len(mean_shape))
    inside = variance > 1e-18 * variance[-1]
    # Directions in which the shape is flat get the scale of its widest one.
    scale = 1.0 / np.sqrt(np.where(inside, variance, variance[-1] or 1.0))
    whitening = (axes * scale) @ axes.T
    white_motion = motion @ np.linalg.inv(whitening)
    return canonical_rotation(mean_shape @ whitening, white_motion) @ whitening


def euclidean_space(
    mean_shape: NDArray, motion: NDArray, size: float | None
) -> NDArray:
    """
    Return the scaled rotation of space that shows the mean shape from front.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        B_0, centred.
    motion : ndarray of shape (n_frames, 2, 3)
        Calibrated cameras, each divided by the size of its frame.
    size : float or None
        Factor by which shapes are multiplied. None makes the mean square of the
        coordinates of the mean shape one.

    Returns
    -------
    ndarray of shape (3, 3)
        A positive multiple of the orthogonal matrix of `canonical_rotation`.
    """
    if size is None:
        size = 1.0 / (np.sqrt(np.mean(mean_shape**2)) or 1.0)
    return size * canonical_rotation(mean_shape, motion)


class Gauge(NamedTuple):
    """
    Canonical shapes.

    Attributes
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape in the canonical space.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes in the canonical space, order and scale.
    order : ndarray of int, shape (n_components,)
        Index of each basis shape in the given basis.
    factors : ndarray of shape (n_components,)
        Factor by which each was multiplied, zero for those without motion.
    """

    mean_shape: NDArray
    basis: NDArray
    order: NDArray
    factors: NDArray


def canonical_gauge(
    mean_shape: NDArray,
    basis: NDArray,
    motion: NDArray,
    alpha: NDArray,
    space: NDArray,
) -> Gauge:
    """
    Return the canonical shapes among those that fit equally well.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        B_0, centred.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, each divided by the size of its frame.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    space : ndarray of shape (3, 3)
        The affinity of space, of `canonical_space` or `euclidean_space`.

    Returns
    -------
    Gauge
        The shapes in that space. The basis is sorted by decreasing energy in the
        images, ``sum_i ||alpha_ik M_i B_k||_F^2``. Its scales and signs are such that
        the coefficients have unit variance over the frames (unit mean square where they
        do not vary) and a third moment that is not negative. A basis shape without
        motion becomes zero.
    """
    energy = image_energies(motion, basis, alpha)
    order = np.argsort(-energy, kind="stable")
    rigid = image_energies(motion, mean_shape[None], np.ones((len(motion), 1)))
    # Others hold only rounding errors.
    moving = energy > OF_RANKS**2 * rigid
    sizes = coefficient_sizes(alpha)
    factors = np.where(moving, orientations(alpha.T) * sizes, 0.0)
    scaled = factors[:, None, None] * basis
    return Gauge(mean_shape @ space.T, scaled[order] @ space.T, order, factors[order])


def coefficient_sizes(alpha: NDArray) -> NDArray:
    """
    Return the sizes of coefficients that become one.

    Parameters
    ----------
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.

    Returns
    -------
    ndarray of shape (n_components,)
        Their standard deviations over the frames, or roots of their mean squares where
        they do not vary.
    """
    deviation = alpha.std(axis=0)
    constant = deviation <= 1e-12 * np.abs(alpha).max(axis=0)
    return np.where(constant, np.sqrt(np.mean(alpha**2, axis=0)), deviation)


def image_energies(motion: NDArray, basis: NDArray, alpha: NDArray) -> NDArray:
    """
    Return how much each basis shape moves the points in the images.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.

    Returns
    -------
    ndarray of shape (n_components,)
        ``sum_i ||alpha_ik M_i B_k||_F^2``.
    """
    cameras = motion.transpose(0, 2, 1) @ motion
    weighted = np.tensordot(alpha**2, cameras, axes=(0, 0))
    return np.einsum("kab,kab->k", weighted, basis.transpose(0, 2, 1) @ basis)


def mode_covariance(motion: NDArray, alpha: NDArray) -> NDArray:
    """
    Return the mode covariance matrix of given cameras and coefficients.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.

    Returns
    -------
    ndarray of shape (3 * n_components, 3 * n_components)
        ``(1 / 2I) sum_i (alpha_i alpha_i^T) (x) (M_i^T M_i)``. This is the covariance
        over the images of Brandt et al. (2018), section 3.3, if the motion has block
        structure.
    """
    total = np.zeros((3 * alpha.shape[1],) * 2)
    for start in range(0, len(alpha), BLOCK_FRAMES):
        part = slice(start, start + BLOCK_FRAMES)
        blocks = np.einsum("ik,irc->irkc", alpha[part], motion[part])
        blocks = blocks.reshape(-1, len(total))
        total += blocks.T @ blocks
    return total / (2 * len(alpha))


def reorder_blocks(matrix: NDArray, order: NDArray) -> NDArray:
    """
    Return a matrix with its 3x3 blocks in another order.

    Parameters
    ----------
    matrix : ndarray of shape (3 * n_blocks, 3 * n_blocks)
        The matrix.
    order : ndarray of int, shape (n_blocks,)
        Index of each block in the given matrix.

    Returns
    -------
    ndarray of shape (3 * n_blocks, 3 * n_blocks)
        The matrix with rows and columns rearranged.
    """
    index = (3 * order[:, None] + np.arange(3)).ravel()
    return matrix[np.ix_(index, index)]
