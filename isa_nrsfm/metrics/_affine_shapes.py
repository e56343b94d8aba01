"""Measures of shapes up to an affinity of space, which images leave undetermined."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from isa_nrsfm.metrics._alignment import (
    best_affinity,
    match_basis,
    match_basis_up_to_affinity,
    quotient,
    unit_shapes,
    without_mean_shape,
)
from isa_nrsfm.metrics._checks import as_mean_shape, as_pair, as_shapes


def affine_shape_error(S: ArrayLike, X: ArrayLike) -> float:
    r"""
    Compare 3D shapes up to one affinity of space and one scale per frame.

    Affine images determine the shapes of all frames up to a common 3x3 affinity A and a
    scale :math:`s_i` of each frame. The error is the mean over the frames of
    :math:`\|S_i - s_i A X_i\|_F / \|S_i\|_F`, with all shapes centred over the points.

    Parameters
    ----------
    S : array-like of shape (n_frames, n_points, 3)
        The true shapes.
    X : array-like of shape (n_frames, n_points, 3)
        The estimated shapes, for example from `AffineNRSfM.reconstruct`.

    Returns
    -------
    float
        The mean relative error: 0 for shapes that are correct up to the affinity and
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

    The scales may be negative. The images of X by an affine camera M and of -X by -M
    are the same. So the sum of squares does not depend on the signs of the X_i. If
    estimates are close to the truth, all scales have the same sign.

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
    truth, shapes = as_pair(S, X, unit_shapes)
    images = shapes @ best_affinity(truth, shapes)
    scales = quotient(np.sum(truth * images, (1, 2)), np.sum(images**2, (1, 2)))
    residuals = truth - scales[:, None, None] * images
    return float(np.mean(np.linalg.norm(residuals, axis=(1, 2))))


def basis_similarity(
    basis_true: ArrayLike,
    basis: ArrayLike,
    *,
    mean_shape_true: ArrayLike | None = None,
    mean_shape: ArrayLike | None = None,
    modulo_mean_shape: bool = False,
    return_matching: bool = False,
) -> Any:
    r"""
    Match basis shapes with the true ones and measure how similar they are.

    The similarity of a true basis shape :math:`B` and an estimated one :math:`B'` is
    :math:`|\langle B, A B' \rangle_F| / (\|B\|_F \|A B'\|_F)`, with one 3x3 affinity A
    for the whole basis. All shapes are centred over the points. Order, signs and scales
    are ignored.

    Parameters
    ----------
    basis_true : array-like of shape (n_components_true, n_points, 3)
        The true basis shapes.
    basis : array-like of shape (n_components, n_points, 3)
        The estimated basis shapes.
    mean_shape_true, mean_shape : array-like of shape (n_points, 3), default=None
        The mean shapes that belong to the bases. If they are given (both or none), A
        is the affinity that maps `mean_shape` onto `mean_shape_true` best in the sense
        of least squares. Otherwise A is estimated from the bases together with the
        matching.
    modulo_mean_shape : bool, default=False
        Whether to remove multiples of the mean shape from the basis shapes first.
        Requires the mean shapes. With affine cameras :math:`B_k` and :math:`B_k + v
        B_0` explain the same images, as the cameras absorb the changes of scale. If
        True, such multiples do not reduce the similarity. If False, the shapes are
        compared unchanged.
    return_matching : bool, default=False
        Whether to return the matching.

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
    maximises the same sum, in alternation with the matching, starting from the identity
    and from affinities that map one basis shape onto a true one. The nine numbers of A
    are fitted to the basis, so the similarities of few basis shapes with few points are
    too large. Give the mean shapes if they are known.

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
    truth, shapes = as_shapes("basis_true", basis_true), as_shapes("basis", basis)
    if truth.shape[1] != shapes.shape[1]:
        raise ValueError(
            "basis_true and basis must have the same points; got "
            f"{truth.shape[1]} and {shapes.shape[1]}"
        )
    truth, shapes = unit_shapes(truth), unit_shapes(shapes)
    if (mean_shape_true is None) != (mean_shape is None):
        raise ValueError("give both mean_shape_true and mean_shape, or none of them")
    if mean_shape_true is not None and mean_shape is not None:
        rigid_true = as_mean_shape("mean_shape_true", mean_shape_true, truth)
        rigid = as_mean_shape("mean_shape", mean_shape, truth)
        if modulo_mean_shape:
            truth = without_mean_shape(truth, rigid_true)
            shapes = without_mean_shape(shapes, rigid)
        affinity = np.linalg.lstsq(rigid, rigid_true)[0]
        rows, columns, cosines = match_basis(truth, shapes, affinity)
    elif modulo_mean_shape:
        raise ValueError("modulo_mean_shape=True needs mean_shape_true and mean_shape")
    else:
        rows, columns, cosines = match_basis_up_to_affinity(truth, shapes)

    similarity = np.zeros(len(truth))
    matching = np.full(len(truth), -1)
    similarity[rows] = cosines
    matching[rows] = columns
    return (similarity, matching) if return_matching else similarity
