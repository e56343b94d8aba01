"""Base class of the strategies of independent subspace analysis, and their steps.

The steps are the density, the fixed-point iteration of FastISA on a batch of starts,
and the grouping of signals into subspaces by greedy pairwise swaps.
"""

from abc import ABCMeta, abstractmethod
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import (
    BaseEstimator,
    ClassNamePrefixFeaturesOutMixin,
    TransformerMixin,
)
from sklearn.utils import gen_batches
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat.blas_threads import one_blas_thread
from isa_nrsfm._compat.scikit_learn import Interval, with_numpy_defaults
from isa_nrsfm._linalg.rounding import OF_DIFFERENCES, OF_PRODUCTS
from isa_nrsfm._tables.sources import unmasked


@with_numpy_defaults
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
        signals, size = unmasked(signals), self.subspace_size
        signals = validate_data(
            self, signals, dtype=float, ensure_min_samples=2, ensure_min_features=size
        )
        n_signals = signals.shape[1]
        if n_signals % size:
            raise ValueError(
                f"the number of signals must be a multiple of subspace_size={size}; "
                f"got n_features={n_signals}"
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


def log_density(energy: NDArray) -> NDArray:
    """Return ``F(u) = -sqrt(u + 0.1)`` of energies, the squared norms of points."""
    return -np.sqrt(energy + 0.1)


def derivatives(energy: NDArray) -> tuple[NDArray, NDArray]:
    """Return the first two derivatives g = F' and g' = F''."""
    root = -1.0 / log_density(energy)
    return -0.5 * root, 0.25 * root**2 * root


def orthogonalise(W: NDArray) -> NDArray:
    """Return the orthogonal matrices ``(W W^T)^(-1/2) W`` nearest to W (n_batch, n, n).

    Eigenvectors of ``W W^T`` take two thirds of the time of an SVD of W. One Newton
    step restores the precision that squaring costs (Higham 2008, chapter 8).
    """
    values, axes = np.linalg.eigh(W @ W.swapaxes(-1, -2))
    poor = values[:, 0] <= 1e-8 * values[:, -1]  # nearly singular
    values[poor] = 1.0
    nearest = (axes / np.sqrt(values)[:, None]) @ (axes.swapaxes(-1, -2) @ W)
    error = nearest @ nearest.swapaxes(-1, -2) - np.eye(W.shape[-1])
    nearest -= 0.5 * error @ nearest
    if poor.any():
        U, _, Vt = np.linalg.svd(W[poor])
        nearest[poor] = U @ Vt
    return nearest


def log_likelihood(W: NDArray, Z: NDArray, subspace_size: int) -> NDArray:
    """Return ``sum_k E F(u_k)``, the mean log-likelihood of a sample up to a constant.

    W is (..., n_signals, n_signals), orthogonal, Z (n_signals, n_samples), white.
    """
    Y = W @ Z
    u = (Y * Y).reshape(*W.shape[:-2], -1, subspace_size, Z.shape[1]).sum(axis=-2)
    return log_density(u).mean(axis=-1).sum(axis=-1)


def fixed_point_step(
    W: NDArray, Z: NDArray, subspace_size: int, length: NDArray | float = 1.0
) -> NDArray:
    """Return W (n_batch, n, n) after one step of FastISA (Hyvarinen and Koster 2006).

    A row w of subspace k, with y = w z, becomes ``E[z y g(u_k)] - E[g(u_k) + 2 y^2
    g'(u_k)] w``. Then W is orthogonalised. If the step length (n_batch,) is below 1.0,
    a multiple of w is added. Each row then turns by about this share of the full step.
    The fixed points are the same.
    """
    n_batch, n_signals, n_samples = len(W), *Z.shape
    Y = (W @ Z).reshape(n_batch, -1, subspace_size, n_samples)
    square = Y * Y
    g, dg = derivatives(square.sum(axis=2))
    curvature = g.sum(axis=-1)[..., None] + 2.0 * np.vecdot(square, dg[:, :, None])
    Y *= g[:, :, None]
    step = Y.reshape(n_batch, n_signals, n_samples) @ Z.T
    step -= curvature.reshape(n_batch, n_signals, 1) * W
    kept = np.vecdot(step, W) * (1.0 / np.reshape(length, (-1, 1)) - 1.0)
    step += kept[..., None] * W
    return orthogonalise(step)


def subspace_change(W: NDArray, W_new: NDArray, subspace_size: int) -> NDArray:
    """
    Return the largest change (n_batch,) of a subspace between two orthogonal matrices.

    It is ``||P_k - P_new,k||_F^2 / (2 d)`` with projectors ``P_k = W_k^T W_k``, the
    mean square sine of the d principal angles: rows may rotate inside their subspace.
    """
    shape = (len(W), -1, subspace_size, W.shape[-1])
    cosines = W.reshape(shape) @ W_new.reshape(shape).swapaxes(-1, -2)
    return np.max(1.0 - np.sum(cosines**2, axis=(-1, -2)) / subspace_size, axis=1)


def iterate(
    W: NDArray, Z: NDArray, subspace_size: int, *, max_iter: int, tol: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Repeat `fixed_point_step` on each start until `subspace_change` is below `tol`.

    With few samples the published iteration mostly ends in cycles. If a start cycles,
    its step length is halved. Returns the last iterates (n_batch, n, n), and for each
    start the number of steps and whether it has converged.
    """
    W = W.copy()
    n_iter = np.zeros(len(W), dtype=int)
    converged = np.zeros(len(W), dtype=bool)
    running = np.arange(len(W))
    length = np.ones(len(W))
    least_change = np.full(len(W), np.inf)
    waited = np.zeros(len(W), dtype=int)
    for _ in range(max_iter):
        # A step of each running start. Its change is scaled to a step of length 1.
        lengths = length[running]
        new = fixed_point_step(W[running], Z, subspace_size, lengths)
        change = subspace_change(W[running], new, subspace_size) / lengths**2
        W[running] = new
        n_iter[running] += 1

        # Halve the step length of starts whose change has not fallen for ten steps.
        nearer = change < least_change[running]
        least_change[running[nearer]] = change[nearer]
        waited[running] = np.where(nearer, 0, waited[running] + 1)
        cycling = running[waited[running] >= 10]
        length[cycling] = np.maximum(length[cycling] / 2, 1 / 16)
        waited[cycling] = 0

        # Starts that have converged stop.
        still = change < tol
        converged[running[still]] = True
        running = running[~still]
        if not len(running):
            break
    return W, n_iter, converged


# Takes groups of signals (n_groups, subspace_size) and returns the value of each.
Values = Callable[[NDArray], NDArray]


def swap_until_best(groupings: Sequence[NDArray], value: Values) -> list[NDArray]:
    """Swap the two signals with the largest gain, until no swap has a gain.

    Groupings (n_signals,) are numbers of subspaces to start from, the gain is that of
    the sum of values. Returns for each an order (n_signals,) of the signals in which
    subspaces are consecutive.
    """
    # with_b[a, b] is the value of the subspace of a with a replaced by b. Row a depends
    # only on the mates of a, the signals of its subspace. A swap changes the mates of
    # two subspaces, so only their rows are computed again.
    n_signals, orders = len(groupings[0]), []
    with_b, itself = np.zeros((n_signals, n_signals)), np.eye(n_signals, dtype=bool)
    mates_before = ~itself
    for grouping in groupings:
        grouping = grouping.copy()
        while True:
            mates = grouping[:, None] == grouping
            changed = (mates != mates_before).any(axis=1, keepdims=True)
            a, b = np.nonzero(changed & (~mates | itself))
            rest = np.nonzero(mates & ~itself)[1].reshape(n_signals, -1)
            with_b[a, b] = value(np.column_stack([rest[a], b]))
            mates_before = mates
            own = np.diag(with_b)
            gain = with_b - own[:, None]
            gain = np.where(mates, 0.0, gain + gain.T)
            pair = np.array(np.unravel_index(np.argmax(gain), gain.shape))
            if not gain[tuple(pair)] > OF_DIFFERENCES * np.abs(own).sum():
                break
            grouping[pair] = grouping[pair[::-1]]
        _, first, group = np.unique(grouping, return_index=True, return_inverse=True)
        orders.append(np.argsort(first[group], kind="stable"))
    return orders


def energy_shares(covariance: NDArray) -> Values:
    """Return the values for pooling by a covariance (n_signals, n_signals).

    They are shares of the energy of the covariance inside the diagonal blocks of the
    subspaces (Brandt et al. 2018, section 3.3).
    """
    energy = covariance**2 / np.sum(covariance**2)
    return lambda groups: energy[groups[:, :, None], groups[:, None]].sum(axis=(1, 2))


def likelihoods(signals: NDArray) -> Values:
    """Return the values for the likelihood ``sum_k E F(u_k)`` of white signals."""
    square = signals**2

    def value(groups: NDArray) -> NDArray:
        values = np.empty(len(groups))
        for part in gen_batches(len(groups), 1 + 2**20 // square.shape[1]):
            energy = square[groups[part]].sum(axis=1)
            values[part] = log_density(energy).mean(axis=1)
        return values

    return value
