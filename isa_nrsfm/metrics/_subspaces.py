"""Measures of groupings of directions into subspaces."""

from bisect import bisect_left

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from isa_nrsfm.metrics._shapes import as_finite, check_same_shape


def subspace_distance(
    components_a: ArrayLike, components_b: ArrayLike, subspace_size: int = 3
) -> float:
    r"""
    Compare two groupings of directions into subspaces.

    Consecutive groups of `subspace_size` rows span K subspaces on either side. They are
    matched one to one. The distance of a pair is the root mean square of the sines of
    its principal angles. The result is the distance of the worst pair in the best
    matching.

    Parameters
    ----------
    components_a, components_b : array-like of shape (n_components, n_features)
        The directions, one per row. Only the span of each group matters: rows may be
        rotated, scaled or mixed within their group, and groups may be permuted. They
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
    its `components_` with the true unmixing. Angles are meaningful only if the signals
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
    check_same_shape("components_a", bases_a, "components_b", bases_b)
    # Component of b orthogonal to a; 1 - cosine^2 would lose half of the digits.
    inner = np.einsum("kim,ljm->klij", bases_a, bases_b)
    outside = bases_b - np.einsum("klij,kim->kljm", inner, bases_a)
    distances = np.sqrt(np.sum(outside**2, axis=(2, 3)) / subspace_size)
    return min(_bottleneck(distances), 1.0)  # rounding may lead beyond 1


def _orthonormal_blocks(name: str, components: ArrayLike, size: int) -> NDArray:
    """Return orthonormal bases (K, size, n_features) of the groups of rows."""
    if size != int(size) or size < 1:
        raise ValueError(f"subspace_size must be a positive integer; got {size!r}")
    rows = as_finite(name, components)
    if rows.ndim != 2 or not rows.size or len(rows) % size:
        raise ValueError(
            f"{name} must be of the shape (n_components, n_features) with a multiple "
            f"of subspace_size={size} rows; got the shape {rows.shape}"
        )
    blocks = rows.reshape(-1, size, rows.shape[1])
    ranks = np.linalg.matrix_rank(blocks)
    if (ranks < size).any():
        block = np.flatnonzero(ranks < size)[0]
        raise ValueError(
            f"each group of {size} rows of {name} must be linearly independent; "
            f"group {block} has rank {ranks[block]}"
        )
    return np.linalg.svd(blocks, full_matrices=False)[2]


def _bottleneck(costs: NDArray) -> float:
    """Return the largest cost of a matching, minimised over all matchings."""

    def sufficient(level: float) -> bool:
        too_large = costs > level
        return not too_large[linear_sum_assignment(too_large)].any()

    levels = np.unique(costs)
    return float(levels[bisect_left(levels, True, key=sufficient)])
