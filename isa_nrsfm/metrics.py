"""Measures of a factorisation, blind to what the images cannot determine."""

from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from sklearn.utils import check_array

from isa_nrsfm._affine_alignment import (
    best_affinity,
    match_basis,
    match_basis_up_to_affinity,
    quotient,
    unit_shapes,
    without_mean_shape,
)
from isa_nrsfm._tracks import LAYOUTS, Layout, table_to_tracks

__all__ = [
    "affine_shape_error",
    "basis_similarity",
    "inverse_snr",
    "subspace_distance",
]


def inverse_snr(
    X: ArrayLike,
    X_hat: ArrayLike,
    *,
    layout: Layout = "interleaved",
    scale_frames: bool = False,
) -> float:
    r"""
    Compute the energy of the reprojection error relative to that of the table.

    This is :math:`\|W - \hat W\|_F^2 / \|W\|_F^2`, where W and :math:`\hat W` are the
    two tables with every frame centred over its points.

    Parameters
    ----------
    X : array-like of shape (n_frames, 2 * n_points)
        The table. Points of which a coordinate is NaN were not seen: they are left
        out, in both tables, of the centroids and of the sums.
    X_hat : array-like of shape (n_frames, 2 * n_points)
        The reprojection. It must be finite at the points seen in `X`.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=False
        Whether to divide the frames of both tables by the root mean square of the
        centred coordinates seen in the frame of `X`, so that small and large images
        count alike. This is the weighting of ``AffineNRSfM(scale_frames=True)``.

    Returns
    -------
    float
        The inverse signal-to-noise ratio, a fraction (not percent): 0 for a perfect
        reprojection, 1 if nothing but the centroids is reprojected.

    Raises
    ------
    ValueError
        If the tables differ in shape, have an odd number of columns or infinite
        entries, if a seen point has no reprojection, or if there is no energy to
        compare with: all seen points equal in every frame (with `scale_frames`, in any
        frame where points are seen).

    Examples
    --------
    >>> from isa_nrsfm.metrics import inverse_snr
    >>> X = [[0.0, 0.0, 2.0, 0.0], [5.0, 5.0, 5.0, 7.0]]
    >>> X_hat = [[0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    >>> inverse_snr(X, X_hat)
    0.125
    """
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {LAYOUTS}; got {layout!r}")
    energy, error, seen = frame_energies(X, X_hat, layout)
    if scale_frames:
        used = seen.any(axis=1)
        flat = np.flatnonzero(used & (energy == 0))
        if len(flat):
            raise ValueError(
                "scale_frames=True needs two different seen points in each frame; all "
                f"are equal in {len(flat)} frame(s), the first is row {flat[0]}"
            )
        weights = seen.sum(axis=1)[used] / energy[used]
        energy, error = energy[used] * weights, error[used] * weights
    if not energy.sum() > 0:
        raise ValueError("X has no energy: all seen points are equal in every frame")
    return float(error.sum() / energy.sum())


def frame_energies(
    X: ArrayLike, X_hat: ArrayLike, layout: Layout
) -> tuple[NDArray, NDArray, NDArray]:
    """Return each frame's energy, that of its error, and the mask of seen points."""
    truth, seen, fitted = _paired_tracks(X, X_hat, layout)
    truth, fitted = _centre_seen(truth, seen), _centre_seen(fitted, seen)
    energy = np.sum(truth**2, axis=(1, 2))
    return energy, np.sum((truth - fitted) ** 2, axis=(1, 2)), seen


def _paired_tracks(
    X: ArrayLike, X_hat: ArrayLike, layout: Layout
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the tracks of both tables, zero where not seen, and the mask of seen."""
    tables = [
        check_array(
            table, dtype=np.float64, ensure_all_finite="allow-nan", input_name=name
        )
        for table, name in ((X, "X"), (X_hat, "X_hat"))
    ]
    _check_same_shape("X", tables[0], "X_hat", tables[1])
    truth, fitted = (table_to_tracks(table, layout) for table in tables)
    seen = ~np.isnan(truth).any(axis=2)
    lost = seen & np.isnan(fitted).any(axis=2)
    if lost.any():
        row = np.flatnonzero(lost.any(axis=1))[0]
        raise ValueError(
            f"X_hat is NaN at {lost.sum()} point(s) that are seen in X, the first in "
            f"row {row}"
        )
    mask = seen[..., None]
    return np.where(mask, truth, 0.0), seen, np.where(mask, fitted, 0.0)


def _centre_seen(tracks: NDArray, seen: NDArray) -> NDArray:
    """Centre each frame over its seen points; the others stay zero."""
    n_seen = np.maximum(seen.sum(axis=1), 1)
    centroids = tracks.sum(axis=1) / n_seen[:, None]
    return (tracks - centroids[:, None]) * seen[..., None]


def affine_shape_error(S: ArrayLike, X: ArrayLike) -> float:
    r"""
    Compare 3D shapes up to one affinity of space and one scale per frame.

    Affine images determine the shapes of all frames up to a common 3x3 affinity A and
    a scale :math:`s_i` of each frame. This is the mean over the frames of
    :math:`\|S_i - s_i A X_i\|_F / \|S_i\|_F`, all shapes centred over the points.

    Parameters
    ----------
    S : array-like of shape (n_frames, n_points, 3)
        The true shapes.
    X : array-like of shape (n_frames, n_points, 3)
        The shapes to be judged, as `AffineNRSfM.reconstruct` returns them.

    Returns
    -------
    float
        The mean relative error: 0 for shapes that are right up to the affinity and
        the scales, at most 1.

    Raises
    ------
    ValueError
        If the arrays differ in shape, are not of the shape above, have entries that
        are not finite, or if all points of a true shape are equal.

    Notes
    -----
    A and the :math:`s_i` minimise the sum of squares
    :math:`\sum_i \|S_i - s_i A X_i\|_F^2 / \|S_i\|_F^2`; the mean of the norms is then
    returned. The best :math:`s_i` for a given A has a closed form, which leaves a
    smooth function of A that depends on the frames through 3x3 matrices only. It is
    minimised to machine precision by Newton's method from several deterministic
    starts.

    The scales may be negative. An affine camera M sees in X what -M sees in -X, so
    the images do not tell a shape from its reflection through the centroid, and the
    sum of squares does not depend on the signs of the X_i. For estimates that resemble
    the truth all scales have the same sign.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> from isa_nrsfm.metrics import affine_shape_error
    >>> tracks = make_nonrigid_tracks(amplitude=0.2, random_state=0)
    >>> S = tracks.shapes
    >>> affinity = [[1.0, 0.5, 0.0], [0.0, 2.0, 0.0], [0.3, 0.0, 0.4]]
    >>> affine_shape_error(S, S @ affinity) < 1e-12
    True

    The mean shape alone leaves the deformation as the error:

    >>> round(affine_shape_error(S, np.broadcast_to(tracks.mean_shape, S.shape)), 2)
    0.18
    """
    truth, shapes = _as_shapes("S", S), _as_shapes("X", X)
    _check_same_shape("S", truth, "X", shapes)
    truth = unit_shapes(truth)
    flat = np.flatnonzero(~truth.any(axis=(1, 2)))
    if len(flat):
        raise ValueError(
            "each true shape must have at least two different points; all points are "
            f"equal in {len(flat)} frame(s) of S, the first is {flat[0]}"
        )
    shapes = unit_shapes(shapes)
    images = shapes @ best_affinity(truth, shapes)
    scales = quotient(np.sum(truth * images, (1, 2)), np.sum(images**2, (1, 2)))
    residuals = truth - scales[:, None, None] * images
    return float(np.mean(np.linalg.norm(residuals, axis=(1, 2))))


@overload
def basis_similarity(
    basis_true: ArrayLike,
    basis: ArrayLike,
    *,
    mean_shape_true: ArrayLike | None = ...,
    mean_shape: ArrayLike | None = ...,
    modulo_mean_shape: bool = ...,
    return_matching: Literal[False] = ...,
) -> NDArray[np.float64]: ...


@overload
def basis_similarity(
    basis_true: ArrayLike,
    basis: ArrayLike,
    *,
    mean_shape_true: ArrayLike | None = ...,
    mean_shape: ArrayLike | None = ...,
    modulo_mean_shape: bool = ...,
    return_matching: Literal[True],
) -> tuple[NDArray[np.float64], NDArray[np.intp]]: ...


def basis_similarity(
    basis_true: ArrayLike,
    basis: ArrayLike,
    *,
    mean_shape_true: ArrayLike | None = None,
    mean_shape: ArrayLike | None = None,
    modulo_mean_shape: bool = False,
    return_matching: bool = False,
) -> NDArray[np.float64] | tuple[NDArray[np.float64], NDArray[np.intp]]:
    r"""
    Match basis shapes with the true ones and measure how similar they are.

    The similarity of a true basis shape :math:`B` and an estimated one :math:`B'` is
    :math:`|\langle B, A B' \rangle_F| / (\|B\|_F \|A B'\|_F)`, all shapes centred over
    the points, with one 3x3 affinity A for the whole basis. It ignores order, signs
    and scales.

    Parameters
    ----------
    basis_true : array-like of shape (n_components_true, n_points, 3)
        The true basis shapes.
    basis : array-like of shape (n_components, n_points, 3)
        The basis shapes to be judged.
    mean_shape_true, mean_shape : array-like of shape (n_points, 3), default=None
        The mean shapes that belong to the bases. If they are given (both or none), A
        is the affinity that maps `mean_shape` onto `mean_shape_true` best in the sense
        of least squares. Otherwise A is estimated from the bases together with the
        matching.
    modulo_mean_shape : bool, default=False
        Whether to take the multiples of the mean shape out of the basis shapes first;
        needs the mean shapes. With affine cameras :math:`B_k` and :math:`B_k + v B_0`
        explain the same images, as the cameras absorb the changes of scale. With True
        the similarity is not reduced by this, with False it measures the shapes as
        they are.
    return_matching : bool, default=False
        Whether to return the matching, too.

    Returns
    -------
    similarity : ndarray of shape (n_components_true,)
        The similarities, from 0 to 1, in the order of the true basis; 0 where a basis
        shape is zero or, with fewer estimated basis shapes, has no partner.
    matching : ndarray of shape (n_components_true,)
        Index of the partner in `basis` of each true basis shape, -1 where there is
        none. Only returned if `return_matching` is True.

    Raises
    ------
    ValueError
        If the arrays are not of the shapes above, differ in their points, have entries
        that are not finite, or if only one mean shape is given or one is missing for
        `modulo_mean_shape`.

    Notes
    -----
    The matching maximises the sum of the squared similarities. Without mean shapes A
    maximises the same sum, in alternation with the matching, from the identity and
    from the affinities that map single basis shapes onto single true ones. The nine
    numbers of A are fitted to the basis, so that the similarities of few basis shapes
    with few points are larger than they deserve; give the mean shapes where they are
    known.

    Examples
    --------
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> from isa_nrsfm.metrics import basis_similarity
    >>> basis = make_nonrigid_tracks(random_state=0).basis
    >>> affinity = [[1.0, 0.5, 0.0], [0.0, 2.0, 0.0], [0.3, 0.0, 0.4]]
    >>> estimate = -3.0 * basis[[1, 2, 0]] @ affinity
    >>> similarity, matching = basis_similarity(basis, estimate, return_matching=True)
    >>> similarity.round(6)
    array([1., 1., 1.])
    >>> matching
    array([2, 0, 1])
    """
    truth, shapes = _as_shapes("basis_true", basis_true), _as_shapes("basis", basis)
    _check_same_points("basis_true", truth, "basis", shapes)
    truth, shapes = unit_shapes(truth), unit_shapes(shapes)
    if (mean_shape_true is None) != (mean_shape is None):
        raise ValueError("give both mean_shape_true and mean_shape, or none of them")
    if mean_shape_true is not None and mean_shape is not None:
        rigid_true = _as_mean_shape("mean_shape_true", mean_shape_true, truth)
        rigid = _as_mean_shape("mean_shape", mean_shape, truth)
        if modulo_mean_shape:
            truth = without_mean_shape(truth, rigid_true)
            shapes = without_mean_shape(shapes, rigid)
        affinity = np.linalg.lstsq(rigid, rigid_true)[0]
        matched = match_basis(truth, shapes, affinity)
    elif modulo_mean_shape:
        raise ValueError("modulo_mean_shape=True needs mean_shape_true and mean_shape")
    else:
        matched = match_basis_up_to_affinity(truth, shapes)

    similarity = np.zeros(len(truth))
    matching = np.full(len(truth), -1)
    similarity[matched.rows] = matched.cosines
    matching[matched.rows] = matched.columns
    return (similarity, matching) if return_matching else similarity


def subspace_distance(
    components_a: ArrayLike, components_b: ArrayLike, subspace_size: int = 3
) -> float:
    r"""
    Compare two groupings of directions into subspaces.

    Consecutive groups of `subspace_size` rows span K subspaces on either side. They
    are matched one to one; the distance of a pair is the root mean square of the sines
    of its principal angles. The result is that of the worst pair, for the matching
    that makes it smallest.

    Parameters
    ----------
    components_a, components_b : array-like of shape (n_components, n_features)
        The directions, one a row. Only the span of each group counts: rows may be
        turned, scaled or mixed within their group, and groups may change places. They
        need not be orthonormal.
    subspace_size : int, default=3
        Number of rows of each group.

    Returns
    -------
    float
        The distance, from 0 (the same subspaces) to 1 (some subspace is orthogonal to
        its partner). It is a metric on sets of K subspaces.

    Raises
    ------
    ValueError
        If the arrays differ in shape, are not of the shape above, have entries that
        are not finite, if `subspace_size` does not divide the number of rows, or if
        the rows of a group are linearly dependent.

    Notes
    -----
    To judge an independent subspace analysis of signals with a known mixing, compare
    its `components_` with the true unmixing. Angles have a meaning where the signals
    are white. If the observed signals are x = A s, with groups of independent white
    sources s, and z = V x are the whitened signals that were analysed, then compare
    `components_` with the inverse of V A. If x itself was analysed, `components_`
    includes the whitening, and its product with the inverse of V is to be compared.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.metrics import subspace_distance
    >>> truth = np.eye(4)
    >>> float(round(subspace_distance(truth, truth[[3, 2, 0, 1]], 2), 6))
    0.0

    The first plane turned about one of its axes by 30 degrees, which has the sine 0.5:

    >>> turned = np.eye(4)
    >>> turned[0] = np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6), 0.0
    >>> float(round(subspace_distance(truth, turned, 2), 6))
    0.353553
    """
    bases_a = _orthonormal_blocks("components_a", components_a, subspace_size)
    bases_b = _orthonormal_blocks("components_b", components_b, subspace_size)
    _check_same_shape("components_a", bases_a, "components_b", bases_b)
    # What is left of b outside of a; 1 - cosine^2 would lose half of the digits.
    inner = np.einsum("kim,ljm->klij", bases_a, bases_b)
    outside = bases_b - np.einsum("klij,kim->kljm", inner, bases_a)
    distances = np.sqrt(np.sum(outside**2, axis=(2, 3)) / subspace_size)
    return min(_bottleneck(distances), 1.0)  # rounding may lead beyond 1


def _orthonormal_blocks(name: str, components: ArrayLike, size: int) -> NDArray:
    """Return orthonormal bases (K, size, n_features) of the groups of rows."""
    if size != int(size) or size < 1:
        raise ValueError(f"subspace_size must be a positive integer; got {size!r}")
    rows = _as_finite(name, components)
    if rows.ndim != 2 or not rows.size or len(rows) % size:
        raise ValueError(
            f"{name} must be of the shape (n_components, n_features) with a multiple "
            f"of subspace_size={size} rows; got the shape {rows.shape}"
        )
    n_features = rows.shape[1]
    blocks = rows.reshape(-1, size, n_features)
    _, singular_values, bases = np.linalg.svd(blocks, full_matrices=False)
    tolerance = max(size, n_features) * np.finfo(float).eps
    ranks = np.sum(singular_values > tolerance * singular_values[:, :1], axis=1)
    if (ranks < size).any():
        block = np.flatnonzero(ranks < size)[0]
        raise ValueError(
            f"each group of {size} rows of {name} must be linearly independent; "
            f"group {block} has rank {ranks[block]}"
        )
    return bases


def _bottleneck(costs: NDArray) -> float:
    """Return the largest cost in the matching whose largest cost is smallest."""
    levels = np.unique(costs)
    low, high = 0, len(levels) - 1
    while low < high:
        middle = (low + high) // 2
        too_large = costs > levels[middle]
        if too_large[linear_sum_assignment(too_large)].any():
            low = middle + 1
        else:
            high = middle
    return float(levels[low])


def _as_finite(name: str, array: ArrayLike) -> NDArray[np.float64]:
    """Return an array of floats; refuse NaN and infinity."""
    values = np.asarray(array, dtype=np.float64)
    if not np.isfinite(values).all():
        n_bad = int(np.sum(~np.isfinite(values)))
        raise ValueError(f"{name} must be finite; {n_bad} entries are NaN or infinite")
    return values


def _as_shapes(name: str, array: ArrayLike) -> NDArray[np.float64]:
    """Return shapes (n, n_points, 3); refuse anything else."""
    shapes = _as_finite(name, array)
    if shapes.ndim != 3 or shapes.shape[2] != 3 or not shapes.size:
        raise ValueError(
            f"{name} must be of the shape (n, n_points, 3); got {shapes.shape}"
        )
    return shapes


def _as_mean_shape(name: str, array: ArrayLike, basis: NDArray) -> NDArray[np.float64]:
    """Return a centred mean shape with the points of the basis."""
    shape = _as_finite(name, array)
    if shape.shape != basis.shape[1:]:
        raise ValueError(
            f"{name} must be of the shape {basis.shape[1:]} of the basis shapes; got "
            f"{shape.shape}"
        )
    shape = unit_shapes(shape[None])[0]
    if not shape.any():
        raise ValueError(f"all points of {name} are equal")
    return shape


def _check_same_shape(name_a: str, a: NDArray, name_b: str, b: NDArray) -> None:
    """Refuse arrays of different shapes."""
    if a.shape != b.shape:
        raise ValueError(
            f"{name_a} and {name_b} must be of the same shape; got {a.shape} and "
            f"{b.shape}"
        )


def _check_same_points(name_a: str, a: NDArray, name_b: str, b: NDArray) -> None:
    """Refuse shapes with different numbers of points."""
    if a.shape[1] != b.shape[1]:
        raise ValueError(
            f"{name_a} and {name_b} must have the same points; got {a.shape[1]} and "
            f"{b.shape[1]}"
        )
