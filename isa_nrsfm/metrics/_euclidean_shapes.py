"""Measures of shapes up to rotations, in the conventions of the literature."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._linalg.rounding import OF_STEPS
from isa_nrsfm.metrics._checks import as_pair

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

    - "frame": an orthogonal matrix :math:`O_i` and a scale :math:`c_i` of its own align
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
        factor = shared.sum(axis=1) / np.where(energy > 0, energy, 1.0)
        aligned = factor[:, None, None] * aligned
    return truth - aligned
