"""The canonical choice among shapes and cameras that fit a table equally well.

An affinity of space (with calibrated cameras a rotation) and the order, scale and sign
of the basis shapes are free. Here they are fixed. The sign of depth is a convention:
images do not distinguish an object from its mirror image, but hidden points may
(`TableModel.mirror_certainty`).

A fit determines the shapes of the frames, up to one affinity of space and one scale a
frame. It does not determine their basis. Three replacements fit equally well. In the
independent basis they are fixed as well:

- B_0 by ``B_0 + sum_k u_k B_k``, fixed by coefficients with mean zero;
- B_k by ``B_k + v_k B_0``, which the scales of the cameras absorb, fixed by basis
  shapes without a part along the mean shape;
- any invertible mixing of the basis shapes, fixed by independence. This is the
  assumption of Brandt, Ackermann, Grasshof (2018), but with one mixing for all three
  coordinates.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import (
    mean_view,
    pose_effect,
    pose_part,
    stacked_motion,
)
from isa_nrsfm._frames.models import Decomposition, FrameMap
from isa_nrsfm._linalg.rounding import OF_DIFFERENCES, OF_RANKS
from isa_nrsfm._linalg.small_matrices import orientations, polar
from isa_nrsfm.isa._shared_mixing import independent_coefficients, shared_mixing


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
    across = polar(view)[0]
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
    mean_shape: NDArray,
    basis: NDArray,
    motion: NDArray,
    alpha: NDArray,
    space: NDArray,
    n_components: int | None = None,
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return the canonical shapes among those that fit equally well, in a space (3, 3).

    The basis is sorted by decreasing energy in the images, ``sum_i ||alpha_ik M_i
    B_k||_F^2``, with cameras (I, 2, 3) of frames of size one. Coefficients (I, K) get
    unit variance (mean square where they do not vary) and non-negative skewness. A
    basis shape without motion becomes zero.

    Returns the mean shape (J, 3), the basis (K, J, 3), and for each basis shape its
    index in the given basis and its factor (K,), zero for those without motion.
    """
    energy = image_energies(motion, basis, alpha)
    # The leading n_components stay before the others.
    further = np.arange(len(energy)) >= (n_components or len(energy))
    order = np.lexsort((-energy, further))
    rigid = image_energies(motion, mean_shape[None], np.ones((len(motion), 1)))
    # Basis shapes with less energy are rounding errors.
    moving = energy > OF_RANKS**2 * rigid
    factors = np.where(moving, orientations(alpha.T) * coefficient_sizes(alpha), 0.0)
    scaled = factors[:, None, None] * basis
    return mean_shape @ space.T, scaled[order] @ space.T, order, factors[order]


def rigid_gauge(
    mean_shape: NDArray,
    basis: NDArray,
    sizes: NDArray,
    fitted: Callable[[NDArray, NDArray], Decomposition],
    camera: str,
    dtype: Any,
) -> tuple[NDArray, NDArray, NDArray, Decomposition]:
    """Return mean shape, basis, its order, and frames of the paper's pipeline.

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
        mean_shape, basis, new_order, _ = canonical_gauge(
            mean_shape, basis, motion, frames.alpha, space
        )
        order = order[new_order]
        mean_shape, basis = mean_shape.astype(dtype), basis.astype(dtype)
        frames = fitted(mean_shape, basis)
        # Coefficients scale with the basis shapes. If a frame does not determine its
        # coefficients, their solution of minimum norm changes.
        off = coefficient_sizes(frames.alpha)[basis.any(axis=(1, 2))] - 1
        if np.abs(off).max(initial=0.0) <= 1e-6:
            break
    return mean_shape, basis, order, frames


def coefficient_sizes(alpha: NDArray) -> NDArray:
    """Return standard deviations (K,) of alpha (I, K), or RMS where they are zero."""
    deviation = alpha.std(axis=0)
    constant = deviation <= 1e-12 * np.abs(alpha).max(axis=0)
    return np.where(constant, np.sqrt(np.mean(alpha**2, axis=0)), deviation)


def image_energies(motion: NDArray, basis: NDArray, alpha: NDArray) -> NDArray:
    """Return ``sum_i ||alpha_ik M_i B_k||^2`` (K,) of basis shapes (K, J, 3)."""
    weighted = np.tensordot(alpha**2, motion.mT @ motion, axes=(0, 0))
    return np.einsum("kab,kab->k", weighted, basis.mT @ basis)


def mode_covariance(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return the mode covariance matrix of cameras (I, 2, 3) and coefficients (I, K).

    ``(1 / 2I) sum_i (alpha_i alpha_i^T) (x) (M_i^T M_i)``, of shape (3K, 3K), is the
    covariance over the images of Brandt et al. (2018), section 3.3.
    """
    total = np.zeros((3 * alpha.shape[1],) * 2)
    for start in range(0, len(alpha), 4096):  # blocks limit memory
        part = slice(start, start + 4096)
        blocks = stacked_motion(motion[part], alpha[part])[:, 3:]
        total += blocks.T @ blocks
    return total / (2 * len(alpha))


def reorder_blocks(matrix: NDArray, order: NDArray) -> NDArray:
    """Return a matrix of 3x3 blocks with its rows and columns of blocks in an order."""
    index = (3 * order[:, None] + np.arange(3)).ravel()
    return matrix[np.ix_(index, index)]


def independent_gauge(
    shapes: NDArray,
    motion: NDArray,
    alpha: NDArray,
    independence: str | None,
    camera: str = "affine",
    unit: float | None = None,
    n_components: int | None = None,
    remove_pose: bool = False,
) -> tuple[NDArray, NDArray, FrameMap]:
    """Return mean shape and independent basis of a fit, and the map of frames to it.

    Shapes (K + 1, 3, J) are centred. Cameras (I, 2, 3) belong to frames of size one.
    "shapes" makes basis shapes independent over the points, "coefficients" makes
    coefficients independent over the frames. None takes the principal axes. These are
    the mixings of the leading n_components principal axes; further ones follow as they
    are. `unit` is the size in `euclidean_space`. `remove_pose`: the axes are those of
    what calibrated cameras do not predict of the coefficients.
    """
    # The shifts u and v, then the affinity of space.
    shift, motion, alpha = _centred(shapes, motion, alpha, camera)
    shapes = np.tensordot(shift, shapes, 1)
    space = canonical_space(shapes[0].T, motion)
    white = shapes[1:].mT @ space.T
    if camera != "affine":
        space = euclidean_space(shapes[0].T, motion, unit)
    if remove_pose:
        cameras = motion @ np.linalg.inv(space)
        alpha = alpha - pose_part(cameras, pose_effect(cameras, alpha))
    # The mixing of the basis shapes, then their order, scale and signs.
    mixing = np.eye(len(white))
    K = len(white) if n_components is None else n_components
    if independence is None or K < len(white):
        # With calibrated cameras in true proportions: whitened, depths of flat objects
        # would count many times.
        mixing = _principal_axes(shapes[1:].mT @ space.T, alpha)
        white = np.tensordot(mixing, white, 1)
    unmixing = np.linalg.inv(mixing).T
    if independence == "shapes":
        mixing[:K] = shared_mixing(white[:K]) @ mixing[:K]
    elif independence == "coefficients":
        inverse = independent_coefficients((alpha @ unmixing.T)[:, :K])
        mixing[:K] = np.linalg.inv(inverse).T @ mixing[:K]
    basis = np.tensordot(mixing, shapes[1:], 1).mT
    unmixing = np.linalg.inv(mixing).T
    mean_shape, basis, order, factors = canonical_gauge(
        shapes[0].T, basis, motion, alpha @ unmixing.T, space, K
    )
    # Coefficients (1, alpha_i) change by the inverse transpose of the mixing of shapes.
    scale = np.divide(1.0, factors, where=factors != 0, out=np.zeros_like(factors))
    coefficients = np.linalg.inv(shift).T
    coefficients[1:] = scale[:, None] * (unmixing @ coefficients[1:])[order]
    return mean_shape, basis, FrameMap(coefficients, space)


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
