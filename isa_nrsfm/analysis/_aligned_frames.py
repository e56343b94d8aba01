"""Frames aligned in the image, for comparison with coefficients."""

from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, OneToOneFeatureMixin, TransformerMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat.scikit_learn import fit_context


class AlignedFrames(OneToOneFeatureMixin, TransformerMixin, BaseEstimator):
    """
    Align frames with their mean by translation, scale and rotation in the image.

    Generalised Procrustes analysis in the plane (Gower, "Generalized Procrustes
    analysis", 1975). PCA of aligned frames is a baseline for coefficients. It uses the
    same table, but mixes the view with the deformation.

    Attributes
    ----------
    mean_ : ndarray of shape (n_points,)
        The mean of the aligned frames of the fit, complex numbers x + iy of mean zero
        and mean square one.
    n_features_in_ : int
        Number of columns.
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {}

    @fit_context(nested=False)
    def fit(self, X: Any, y: Any = None) -> Self:
        """
        Find the mean of the frames.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A complete table, columns x and y of each point in turn.
        y : None
            Ignored.

        Returns
        -------
        AlignedFrames
            The transformer.
        """
        points = _unit_points(validate_data(self, X, dtype=np.float64))
        mean = points[0]
        for _ in range(100):
            turned = _nearest_turns(points, mean).mean(axis=0)
            turned /= np.sqrt(np.mean(np.abs(turned) ** 2))
            change = np.abs(turned - mean).max()
            mean = turned
            if change < 1e-10:  # of its size
                break
        self.mean_ = mean
        return self

    def transform(self, X: Any) -> NDArray:
        """
        Return the aligned frames.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A complete table, columns x and y of each point in turn.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            Frames of mean zero and mean square one.
        """
        check_is_fitted(self)
        points = _unit_points(validate_data(self, X, dtype=np.float64, reset=False))
        turned = _nearest_turns(points, self.mean_)
        return np.ascontiguousarray(turned).view(float)


def _unit_points(X: NDArray) -> NDArray:
    """Return frames (n, 2J) as complex numbers (n, J) of mean zero, mean square one."""
    if X.shape[1] % 2:
        raise ValueError(f"X must have two columns per point; got {X.shape[1]} columns")
    points = np.ascontiguousarray(X, dtype=float).view(complex)
    points = points - points.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(np.abs(points) ** 2, axis=1, keepdims=True))
    return points / np.where(size > 0, size, 1.0)


def _nearest_turns(points: NDArray, mean: NDArray) -> NDArray:
    """Return frames (n, J) turned to be nearest to a mean (J,)."""
    angles = np.angle(points @ mean.conj())
    return np.asarray(points * np.exp(-1j * angles)[:, None])
