"""Measures of tables, shapes and groupings of directions, up to what images leave open.

Images leave an affinity of space undetermined, a 3x3 matrix that is multiplied from the
right. Papers have several conventions for rotations. Shapes are (n, n_points, 3), one
point a row.
"""

from bisect import bisect_left
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment, minimize
from sklearn.utils import check_array

from isa_nrsfm import _tables
from isa_nrsfm._linalg import OF_STEPS


def inverse_snr(
    X: ArrayLike,
    X_hat: ArrayLike,
    *,
    layout: _tables.Layout = "interleaved",
    scale_frames: bool = False,
) -> float:
    r"""
    Compute the energy of the reprojection error relative to that of the table.

    This is :math:`\|W - \hat W\|_F^2 / \|W\|_F^2`, where W and :math:`\hat W` are the
    two tables with every frame centred over its points.

    Parameters
    ----------
    X : array-like of shape (n_frames, 2 * n_points)
        The table. Points with a NaN coordinate were not seen. They are ignored in both
        tables.
    X_hat : array-like of shape (n_frames, 2 * n_points)
        The reprojection. It must be finite at the points seen in `X`.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=False
        Whether to divide each frame of both tables by the RMS of its centred, seen
        coordinates in `X`. Small and large images then have the same weight, as in
        ``AffineNRSfM(scale_frames=True)``.

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
    if layout not in _tables.LAYOUTS:
        raise ValueError(f"layout must be one of {_tables.LAYOUTS}; got {layout!r}")
    energy, error, seen = frame_energies(X, X_hat, layout)
    if scale_frames:
        used = seen.any(axis=1)
        flat = np.flatnonzero(used & (energy == 0))
        if len(flat):
            raise ValueError(
                f"frames of X whose seen points are all in one place: {len(flat)} of "
                f"{len(energy)} (first: row {flat[0]}). They have no size to scale "
                "them by. Remove them, or use scale_frames=False"
            )
        weights = seen.sum(axis=1)[used] / energy[used]
        energy, error = energy[used] * weights, error[used] * weights
    if not energy.sum() > 0:
        raise ValueError(
            "in each frame of X all seen points are in one place, so that errors "
            "cannot be related to a size. Check how X was read"
        )
    return float(error.sum() / energy.sum())


def frame_energies(
    X: ArrayLike, X_hat: ArrayLike, layout: _tables.Layout
) -> tuple[NDArray, NDArray, NDArray]:
    """Return energies of frames and of their errors, and the mask of seen points."""
    checks = _tables.CHECKS | {"dtype": np.float64}
    truth = check_array(_tables.unmasked(X), input_name="X", **checks)
    fitted = check_array(_tables.unmasked(X_hat), input_name="X_hat", **checks)
    check_same_shape("X", truth, "X_hat", fitted)
    both = (_tables.table_to_tracks(table, layout).mT for table in (truth, fitted))
    truth, fitted = (_tables.without_half_points(rows)[0] for rows in both)
    seen = _tables.seen_points(truth)
    lost = seen & ~_tables.seen_points(fitted)
    if lost.any():
        rows = np.flatnonzero(lost.any(axis=1))
        raise ValueError(
            f"X_hat lacks points that X shows (NaN): {lost.sum()} in {len(rows)} of "
            f"{len(lost)} frames (first: row {rows[0]}). Fill them in, or make them "
            "NaN in X"
        )

    def energies(truth: NDArray, fitted: NDArray) -> tuple[NDArray, NDArray]:
        """Return the energies of a block of frames, and of their errors."""
        fitted = np.where(_tables.seen_points(truth)[:, None], fitted, np.nan)
        truth, fitted = (_tables.centred_frames(rows)[0] for rows in (truth, fitted))
        error = np.nansum((truth - fitted) ** 2, axis=(1, 2))
        return np.nansum(truth**2, axis=(1, 2)), error

    blocks = _tables.FrameBlocks.of_array(truth, 1024)  # copies that stay in the cache
    return *blocks.joined(energies, fitted), seen


def as_finite(name: str, array: ArrayLike) -> NDArray[np.float64]:
    """Return an array of floats; refuse NaN and infinity."""
    values = np.asarray(_tables.unmasked(array), dtype=np.float64)
    if n_bad := np.count_nonzero(~np.isfinite(values)):
        raise ValueError(f"{name} must be finite; {n_bad} entries are NaN or infinite")
    return values


def check_same_shape(name_a: str, a: NDArray, name_b: str, b: NDArray) -> None:
    """Refuse arrays of different shapes."""
    if a.shape != b.shape:
        names = f"{name_a} and {name_b}"
        raise ValueError(
            f"{names} must be of the same shape; got {a.shape} and {b.shape}"
        )


# Places of matched true and estimated basis shapes, and absolute cosines of the pairs.
Matched = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]


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

    similarity, matching = np.zeros(len(truth)), np.full(len(truth), -1)
    similarity[rows], matching[rows] = cosines, columns
    return (similarity, matching) if return_matching else similarity


def match_basis(truth: NDArray, shapes: NDArray, affinity: NDArray) -> Matched:
    """Match unit shapes, the second ones after an affinity, by squared cosines."""
    n_true = len(truth)
    images = normalise(shapes @ affinity, OF_STEPS * float(np.linalg.norm(affinity)))
    inner = truth.reshape(n_true, -1) @ images.reshape(len(images), -1).T
    cosines = np.minimum(np.abs(inner), 1.0)  # rounding may lead beyond 1
    rows, columns = linear_sum_assignment(cosines**2, maximize=True)
    return rows, columns, cosines[rows, columns]


def match_basis_up_to_affinity(truth: NDArray, shapes: NDArray) -> Matched:
    """Match unit shapes under the best affinity for all of them together."""
    starts = [np.eye(3), *(np.linalg.lstsq(x, s)[0] for s in truth for x in shapes)]
    found, tried = [match_basis(truth, shapes, starts[0])], set()
    for start in starts:
        rows, columns, _ = match_basis(truth, shapes, start)
        # The next steps depend only on the pairs: stop if they repeat.
        while (pairs := (rows.tobytes(), columns.tobytes())) not in tried:
            tried.add(pairs)
            affinity = best_affinity(truth[rows], shapes[columns])
            found.append(match_basis(truth, shapes, affinity))
            rows, columns, _ = found[-1]
    return max(found, key=lambda matched: np.sum(matched[2] ** 2))


def without_mean_shape(shapes: NDArray, mean_shape: NDArray) -> NDArray:
    """Remove multiples of the mean shape from unit shapes; return unit shapes.

    The rest is orthogonal to the mean shape in the coordinates in which that is white,
    so that the multiples do not change under an affinity of both.
    """
    dual = np.linalg.pinv(mean_shape).T
    multiples = np.sum(shapes * dual, axis=(1, 2)) / np.sum(mean_shape * dual)
    return normalise(shapes - multiples[:, None, None] * mean_shape, OF_STEPS)


def best_affinity(truth: NDArray, shapes: NDArray) -> NDArray[np.float64]:
    """Return the 3x3 affinity with the largest sum of squared cosines to the truth.

    All shapes are centred and of unit norm, or zero. With the best factor of each pair
    ``sum ||truth - factor * shapes @ affinity||^2`` is the number of pairs less this
    sum, so that the affinity minimises it.
    """
    # The mean scatter becomes the unit matrix; directions without scatter drop out.
    values, axes = np.linalg.eigh(np.mean(shapes.transpose(0, 2, 1) @ shapes, axis=0))
    kept = values > OF_STEPS * values[-1]
    whitener = axes[:, kept] / np.sqrt(values[kept])
    white = shapes @ whitener
    cross = (white.transpose(0, 2, 1) @ truth).reshape(len(truth), -1)
    scatter = white.transpose(0, 2, 1) @ white

    # Equal scatters would make the first of these the solution.
    starts = [cross.sum(axis=0), *np.linalg.svd(cross, full_matrices=False)[2][:3]]
    found = [_climb(start, cross, scatter) for start in starts if start.any()]
    if not found:
        return np.zeros((3, 3))
    _, affinity = max(found, key=lambda item: item[0])
    return whitener @ affinity.reshape(-1, 3)


def _climb(start: NDArray, cross: NDArray, scatter: NDArray) -> tuple[float, NDArray]:
    """Maximise ``sum <a, cross_i>^2 / <a, scatter_i a>`` from a start.

    What is left of each pair is minimised, which rounds less: return minus that, and a.
    """
    fits = np.linalg.pinv(scatter, hermitian=True) @ cross.reshape(len(cross), -1, 3)

    def left(a: NDArray) -> tuple[float, NDArray]:
        half = (scatter @ a.reshape(-1, 3)).reshape(cross.shape)  # half the slope of q
        t = quotient(cross @ a, half @ a)  # the best factor of each pair
        rest = fits - t[:, None, None] * a.reshape(-1, 3)
        return float(np.vdot(rest, scatter @ rest)), 2 * (t**2 @ half - t @ cross)

    options = {"gtol": 1e-13, "ftol": 0.0, "maxiter": 1000}
    a = start / np.linalg.norm(start)
    found = minimize(left, a, jac=True, method="L-BFGS-B", options=options)
    return -float(found.fun), found.x


def quotient(a: NDArray, b: NDArray, smallest: float = OF_STEPS**2) -> NDArray:
    """Divide a by b; zero where b is at most the smallest, by default by rounding."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > smallest)


CONVENTIONS = ("sequence", "frame", "camera")


def mean_shape_error_3d(
    S: ArrayLike,
    X: ArrayLike,
    *,
    convention: Literal["sequence", "frame", "camera"] = "sequence",
    scale: bool | None = None,
) -> float:
    r"""
    Compare 3D shapes up to rotations, as papers on non-rigid structure from motion do.

    All shapes are centred over their points. With :math:`s_{ij}` and :math:`x_{ij}` for
    point j of the true and the estimated shape of frame i, I frames and J points, the
    conventions are

    - "sequence": one orthogonal matrix O aligns all frames,

      .. math:: e_{3D} = \frac{1}{\sigma I J} \sum_{ij} \|s_{ij} - O x_{ij}\|,
                \quad \sigma = \frac{1}{3 I} \sum_i (\sigma_{ix} + \sigma_{iy} +
                \sigma_{iz}),

      with the standard deviations :math:`\sigma_{ix}, \sigma_{iy}, \sigma_{iz}` of the
      coordinates of the true shape over its points: a mean distance, in units of the
      extent of the object along an axis (Akhter et al. 2008; Dai et al. 2014);

    - "frame": an orthogonal matrix :math:`O_i` and its own scale :math:`c_i` align
      each frame,

      .. math:: \frac{1}{I} \sum_i \frac{\|S_i - c_i X_i O_i\|_F}{\|S_i\|_F},

      relative to the size of the whole object (Garg et al. 2013; Kong, Lucey 2019);

    - "camera": shapes are in the axes of the camera of their frame, x right, y down, z
      away. Nothing is aligned, but D is the identity or the mirror image ``z -> -z``,
      the same for all frames,

      .. math:: \min_D \frac{1}{I} \sum_i \frac{\|S_i - X_i D\|_F}{\|S_i\|_F}

      (Lee et al. 2013; Kumar, Van Gool 2022).

    Errors of motion capture are 1.4 to 1.7 times as large in the convention "sequence"
    as in "camera".

    Parameters
    ----------
    S : array-like of shape (n_frames, n_points, 3)
        The true shapes.
    X : array-like of shape (n_frames, n_points, 3)
        The estimated shapes, for example from ``AffineNRSfM.reconstruct(X,
        camera=...)``. Lengths and angles should be true. Shape i in the axes of its
        camera is ``X[i] @ rotations[i].T``, times the scale of the camera.
    convention : {"sequence", "frame", "camera"}, default="sequence"
        Convention of the error. All except "frame" include rotations of the estimated
        shapes relative to each other.
    scale : bool, default=None
        Whether to fit a scale: one for each frame for "frame", a common one for the
        others. The default is True for "frame". It is False for the others, where
        shapes must have the true size.

    Returns
    -------
    float
        The error, 0 for shapes that are correct after the alignment. A shape whose
        points are all equal has the errors 1 ("frame" and "camera") and about 1.6
        ("sequence").

    Raises
    ------
    ValueError
        If the arrays differ in shape, are not of the shape above, have entries that are
        not finite (there is no convention for missing points), if `convention` is not
        one of the three, or if all points of a true shape are equal.

    See Also
    --------
    affine_shape_error : The error up to an affinity of space, for affine cameras.

    Notes
    -----
    The matrices and scales minimise the sum of squared distances (orthogonal
    Procrustes analysis). They may be reflections, because a shape and its mirror image
    have the same orthographic images. With "frame" this applies to each frame, so
    frames that are mirror images of each other have no error.

    The program of Akhter et al. uses the orthogonal matrix that is nearest to the best
    affinity. This is not exactly the best orthogonal matrix: for reconstructions of
    motion capture the errors differ by up to 5 percent. The program of Kong and Lucey
    uses the ratio of the norms as the scale of a frame.

    References
    ----------
    I. Akhter, Y. Sheikh, S. Khan, T. Kanade, "Nonrigid structure from motion in
    trajectory space", Advances in Neural Information Processing Systems 21, 2008.

    Y. Dai, H. Li, M. He, "A simple prior-free method for non-rigid
    structure-from-motion factorization", International Journal of Computer Vision 107,
    2014.

    R. Garg, A. Roussos, L. Agapito, "Dense variational reconstruction of non-rigid
    surfaces from monocular video", IEEE Conference on Computer Vision and Pattern
    Recognition, 2013.

    C. Kong, S. Lucey, "Deep non-rigid structure from motion", IEEE International
    Conference on Computer Vision, 2019.

    M. Lee, J. Cho, C.-H. Choi, S. Oh, "Procrustean normal distribution for non-rigid
    structure from motion", IEEE Conference on Computer Vision and Pattern Recognition,
    2013.

    S. Kumar, L. Van Gool, "Organic priors in non-rigid structure from motion",
    European Conference on Computer Vision, 2022.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> from isa_nrsfm.metrics import mean_shape_error_3d
    >>> S = make_nonrigid_tracks(random_state=0).shapes
    >>> mirrored = S @ np.diag([1.0, 1.0, -1.0])
    >>> mean_shape_error_3d(S, mirrored) < 1e-12
    True

    Shapes of twice the size have no error only with "frame":

    >>> round(mean_shape_error_3d(S, 2 * S), 2)
    1.65
    >>> round(mean_shape_error_3d(S, 2 * S, convention="camera"), 2)
    1.0
    >>> mean_shape_error_3d(S, 2 * S, convention="frame") < 1e-12
    True
    """
    if convention not in CONVENTIONS:
        raise ValueError(f"convention must be one of {CONVENTIONS}; got {convention!r}")
    truth, shapes = as_pair(S, X, _centred)
    if convention == "sequence":
        rest = _rest(truth.reshape(1, -1, 3), shapes.reshape(1, -1, 3), bool(scale))
        return float(np.linalg.norm(rest, axis=2).mean() / truth.std(axis=1).mean())
    if convention == "frame":
        rests = [_rest(truth, shapes, scale is None or scale)]
    else:
        both = [shapes, shapes * [1.0, 1.0, -1.0]]
        energy = np.vdot(shapes, shapes) or 1.0
        factors = [np.vdot(truth, each) / energy if scale else 1.0 for each in both]
        rests = [truth - c * each for c, each in zip(factors, both, strict=True)]
    sizes = np.linalg.norm(truth, axis=(1, 2))
    errors = [np.mean(np.linalg.norm(rest, axis=(1, 2)) / sizes) for rest in rests]
    return float(min(errors))


def _centred(shapes: NDArray) -> NDArray:
    """Return shapes centred over their points; zero if all points are equal."""
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    size = np.abs(shapes).max(axis=(1, 2), keepdims=True)
    largest = np.abs(centred).max(axis=(1, 2), keepdims=True)
    return np.where(largest > OF_STEPS * size, centred, 0.0)


def _rest(truth: NDArray, shapes: NDArray, scale: bool) -> NDArray:
    """Return residuals of pairs of shapes after orthogonal matrices, and scales."""
    left, shared, right = np.linalg.svd(shapes.transpose(0, 2, 1) @ truth)
    aligned = shapes @ (left @ right)
    if scale:
        energy = np.sum(shapes**2, axis=(1, 2))
        factor = quotient(shared.sum(axis=1), energy, 0.0)
        aligned = factor[:, None, None] * aligned
    return truth - aligned


def as_shapes(name: str, array: ArrayLike) -> NDArray[np.float64]:
    """Return shapes (n, n_points, 3); refuse anything else."""
    shapes = as_finite(name, array)
    if shapes.ndim != 3 or shapes.shape[2] != 3 or not shapes.size:
        raise ValueError(
            f"{name} must be of the shape (n, n_points, 3); got {shapes.shape}"
        )
    return shapes


def as_mean_shape(name: str, array: ArrayLike, basis: NDArray) -> NDArray[np.float64]:
    """Return a centred mean shape with the points of the basis."""
    shape = as_finite(name, array)
    if shape.shape != basis.shape[1:]:
        raise ValueError(
            f"{name} must be of the shape {basis.shape[1:]} of the basis shapes; got "
            f"{shape.shape}"
        )
    shape = unit_shapes(shape[None])[0]
    if not shape.any():
        raise ValueError(f"all points of {name} are equal")
    return shape


def as_pair(
    S: ArrayLike, X: ArrayLike, centre: Callable[[NDArray], NDArray]
) -> tuple[NDArray, NDArray]:
    """Return true shapes, none of them flat, and estimated shapes, both centred."""
    truth, shapes = as_shapes("S", S), as_shapes("X", X)
    check_same_shape("S", truth, "X", shapes)
    truth = centre(truth)
    flat = np.flatnonzero(~truth.any(axis=(1, 2)))
    if len(flat):
        raise ValueError(
            f"frames of S whose points are all in one place: {len(flat)} of "
            f"{len(truth)} (first: {flat[0]}). Errors cannot be related to their size. "
            "Remove these frames from S and X"
        )
    return truth, centre(shapes)


def unit_shapes(shapes: NDArray) -> NDArray[np.float64]:
    """Return shapes centred over the points and of unit norm; zero if all are equal."""
    # Shapes of unit size first: squares of very large or small numbers overflow.
    size = np.abs(shapes).max(axis=(1, 2), keepdims=True, initial=0.0)
    shapes = quotient(shapes, size, 0.0)
    return normalise(shapes - shapes.mean(axis=1, keepdims=True), OF_STEPS)


def normalise(shapes: NDArray, smallest: float) -> NDArray[np.float64]:
    """Return shapes of unit norm, and zero for those with a norm up to the smallest."""
    return quotient(
        shapes, np.linalg.norm(shapes, axis=(1, 2), keepdims=True), smallest
    )


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
