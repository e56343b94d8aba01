"""Base class of the strategies of independent subspace analysis."""

from abc import ABCMeta, abstractmethod
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import (
    BaseEstimator,
    ClassNamePrefixFeaturesOutMixin,
    TransformerMixin,
)
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat.blas_threads import one_blas_thread
from isa_nrsfm._compat.scikit_learn import Interval
from isa_nrsfm._linalg.rounding import OF_PRODUCTS
from isa_nrsfm._tables.sources import unmasked


class BaseSubspaceAnalysis(
    ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator, metaclass=ABCMeta
):
    """Validation, whitening and projection. Subclasses implement `_unmix`."""

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "subspace_size": [Interval(Integral, 1, None, closed="left")],
        "n_init": [Interval(Integral, 1, None, closed="left")],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="neither")],
        "random_state": ["random_state"],
    }

    # For matrices of this size, threads take more time than they save.
    @one_blas_thread
    def _fit_signals(self, signals: Any, **fit_params: Any) -> Self:
        """Validate, whiten and unmix signals (n_samples, n_signals)."""
        signals = validate_data(
            self,
            unmasked(signals),
            dtype=np.float64,
            ensure_min_samples=2,
            ensure_min_features=self.subspace_size,
        )
        n_signals = signals.shape[1]
        if n_signals % self.subspace_size:
            raise ValueError(
                f"the number of signals must be a multiple of subspace_size="
                f"{self.subspace_size}; got n_features={n_signals}"
            )
        self.mean_ = signals.mean(axis=0)
        Z, whitening = whiten(signals - self.mean_)
        self.components_ = self._unmix(Z, whitening, **fit_params) @ whitening
        self._n_features_out = n_signals
        return self

    @abstractmethod
    def _unmix(self, Z: NDArray, whitening: NDArray) -> NDArray:
        """Return the orthogonal matrix that unmixes white Z (n_signals, n_samples).

        ``Z = whitening @ (signals - mean_).T``; both matrices are (n_signals,
        n_signals).
        """

    def transform(self, signals: Any) -> NDArray:
        """
        Return the sources.

        Parameters
        ----------
        signals : array-like of shape (n_samples, n_signals)
            The signals, one per column.

        Returns
        -------
        ndarray of shape (n_samples, n_signals)
            ``(signals - mean_) @ components_.T``; consecutive columns form a subspace.
        """
        check_is_fitted(self)
        signals = validate_data(self, unmasked(signals), dtype=np.float64, reset=False)
        return (signals - self.mean_) @ self.components_.T


def whiten(centred: NDArray) -> tuple[NDArray, NDArray]:
    """Return white signals Z (n_signals, n_samples), and the whitening matrix.

    ZCA whitening of the standardised signals: ``Z = whitening @ centred.T`` with ``Z
    Z^T = n_samples I``. White signals stay as they are, up to rounding.
    """
    n_samples, n_signals = centred.shape
    scale = centred.std(axis=0)
    varies = scale > OF_PRODUCTS * np.abs(centred).max(axis=0)
    scale = np.where(varies, scale, 1.0)
    standard = centred / scale
    variance, axes = np.linalg.eigh(standard.T @ standard / n_samples)
    rank = int(np.sum(variance > OF_PRODUCTS * variance[-1]))
    if rank < n_signals:
        raise ValueError(
            f"{n_signals} linearly independent signals are needed; got rank {rank} "
            f"in n_samples={n_samples} samples"
        )
    whitening = (axes / np.sqrt(variance)) @ axes.T / scale
    return np.ascontiguousarray(whitening @ centred.T), whitening
