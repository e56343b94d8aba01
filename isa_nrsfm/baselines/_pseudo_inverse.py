"""The pseudo-inverse method: shapes of least norm, then of low rank."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.small_matrices import polar
from isa_nrsfm._paper.pipeline import leading_triplets
from isa_nrsfm.baselines._base import ShapeSequenceNRSfM
from isa_nrsfm.calibration import orthonormal_cameras


def orthographic_cameras(W: NDArray, rank: int) -> NDArray:
    """Return the orthographic cameras (I, 2, 3) nearest to `orthonormal_cameras` of W.

    The latter are in the span of the first ``3 * rank`` left singular vectors.
    """
    S, Vt, rest = leading_triplets(W, 3 * rank)
    n_columns = int(np.sum(S > OF_RANKS * S[0]))
    if n_columns < 3:
        raise ValueError(
            "orthographic cameras need a table of rank three or more, once frames are "
            f"centred; X has rank {n_columns}, as of a flat object that does not deform"
        )
    n_left = (len(W) - 3 * rank) * (W.shape[1] - 1 - 3 * rank)
    noise_variance = rest / n_left if n_left > 0 else 0.0
    motion = W @ Vt[:n_columns].T
    return polar(orthonormal_cameras(motion, noise_variance).cameras)[0]


def least_norm_shapes(W: NDArray, cameras: NDArray) -> NDArray:
    """Return the flat shapes of least norm ``S_i = R_i^+ W_i`` that reproduce W."""
    return W.reshape(len(cameras), 2, -1).transpose(0, 2, 1) @ cameras


def truncate_rank(shapes: NDArray, rank: int) -> NDArray:
    """Return the nearest shapes whose matrix, one row per frame, has this rank."""
    U, S, Vt = np.linalg.svd(shapes.reshape(len(shapes), -1), full_matrices=False)
    return ((U[:, :rank] * S[:rank]) @ Vt[:rank]).reshape(shapes.shape)


class PseudoInverseNRSfM(ShapeSequenceNRSfM):
    """
    Pseudo-inverse method of non-rigid structure from motion.

    The method finds orthographic cameras R_i, then for each frame the shape of least
    norm that reproduces the image exactly, ``S_i = R_i^+ W_i``. The result are the
    nearest mixtures of ``n_components + 1`` shapes. Depth results from the low rank
    alone and is too small. Row i, reshaped to (n_points, 2), is modelled as::

        shapes_[i] @ motion_[i].T + translation_[i]

    Parameters
    ----------
    n_components : int, default=3
        K, the number of basis shapes without the mean shape; the literature counts the
        mean shape as well. K needs at least 3K + 4 points and ``ceil(8 (K + 2) / 5)``
        frames.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=False
        Whether to divide each centred frame by the root mean square of its coordinates
        before the fit; `motion_` includes the scale. False is for orthographic cameras,
        as published. Use True for photos of different resolution.
    ordered : bool, default=False
        Whether the rows are successive frames of a slowly turning camera. Images do not
        determine the sign of a frame's camera and shape. If True, the sign minimises
        the rotation of the camera from the frame before; if False, signs are chosen to
        make the shapes similar.

    Attributes
    ----------
    mean_shape_ : ndarray of shape (n_points, 3)
        Mean of `shapes_`. x and y are the axes of the mean camera (so y points down
        for image coordinates), z is depth; the mirror image fits equally well.
    basis_ : ndarray of shape (n_components, n_points, 3)
        Principal components of `shapes_`, by decreasing variance; one standard
        deviation each.
    alpha_ : ndarray of shape (n_frames, n_components)
        Coefficients of the principal components for the fitted table, as returned by
        `transform`, with the cameras of `decompose`.
    motion_ : ndarray of shape (n_frames, 2, 3)
        Cameras: orthonormal rows, with `scale_frames` times the size of the frame.
    translation_ : ndarray of shape (n_frames, 2)
        Centroids of the frames, in the units of the table.
    shapes_ : ndarray of shape (n_frames, n_points, 3)
        Shapes of the frames, centred, of rank ``n_components + 1`` as a matrix with
        one row per frame. In the units of the table or, with `scale_frames`, of frames
        of size one.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks, scaled
        as in the fit, and What the image of `shapes_` in `motion_`.
    noise_variance_ : float
        Mean square error of a coordinate after projection of each shape on the model;
        for scaled frames, relative to frames of size one.
    n_features_in_ : int
        Number of columns.
    feature_names_in_ : ndarray of shape (`n_features_in_`,)
        Names of the columns, where the table is a dataframe with string names.

    See Also
    --------
    BlockMatrixNRSfM : Shapes of least nuclear norm.
    isa_nrsfm.AffineNRSfM : Affine cameras, missing points, independent basis shapes.

    Notes
    -----
    The method factorises the given table only. For other frames, `transform` and the
    related methods fit a linear model: the mean and the first `n_components` principal
    components of `shapes_`, with a normal prior of the coefficients. For the fitted
    table they also return the shapes of this model, not `shapes_`. The difference is
    small if `shapes_` are those of a deforming mean shape in orthographic cameras, as
    for `BlockMatrixNRSfM`; it is larger for shapes that lack depth.

    The singular values of the matrix of shapes and their images do not depend on the
    signs of frames, so `inverse_snr_` does not depend on `ordered`.

    Cameras are found by `isa_nrsfm.calibration.orthonormal_cameras` among the mixtures
    of the first ``3 (n_components + 1)`` left singular vectors of W, and made exactly
    orthonormal. A flat object that does not deform does not determine them, and `fit`
    raises a ValueError, as for missing points.

    References
    ----------
    Y. Dai, H. Li, M. He, "A simple prior-free method for non-rigid
    structure-from-motion factorization", International Journal of Computer Vision 107,
    2014.

    Examples
    --------
    >>> from isa_nrsfm.baselines import PseudoInverseNRSfM
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> tracks = make_nonrigid_tracks(100, camera="orthographic", random_state=0)
    >>> model = PseudoInverseNRSfM(n_components=3).fit(tracks.data)
    >>> model.shapes_.shape, model.alpha_.shape
    ((100, 68, 3), (100, 3))
    """

    def _factorise(self, W: NDArray) -> tuple[NDArray, NDArray]:
        """Return cameras and the shapes of least norm, of rank K + 1."""
        rank = self.n_components + 1
        cameras = orthographic_cameras(W, rank)
        return cameras, truncate_rank(least_norm_shapes(W, cameras), rank)
