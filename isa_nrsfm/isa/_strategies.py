"""The strategies: FastISA with many starts (ISA1), and FastICA with pooling (ISA2).

Their steps are the density, the fixed-point iteration of FastISA on a batch of starts,
and the grouping of signals into subspaces by greedy pairwise swaps.
"""

import warnings
from abc import ABCMeta, abstractmethod
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import NDArray
from sklearn.base import (
    BaseEstimator,
    ClassNamePrefixFeaturesOutMixin,
    TransformerMixin,
    clone,
)
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_array, check_random_state, gen_batches
from sklearn.utils.parallel import Parallel, delayed
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat import scikit_learn
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._linalg import OF_DIFFERENCES, OF_PRODUCTS, polar
from isa_nrsfm._tables import unmasked


@scikit_learn.with_numpy_defaults
class BaseSubspaceAnalysis(
    ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator, metaclass=ABCMeta
):
    """Validation, whitening and projection. Subclasses implement `_unmix`."""

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "subspace_size": [scikit_learn.Interval(Integral, 1, None, closed="left")],
        "n_init": [scikit_learn.Interval(Integral, 1, None, closed="left")],
        "max_iter": [scikit_learn.Interval(Integral, 1, None, closed="left")],
        "tol": [scikit_learn.Interval(Real, 0, None, closed="neither")],
        "random_state": ["random_state"],
    }

    # For matrices of this size, threads take more time than they save.
    @scikit_learn.one_blas_thread()
    def _fit_signals(self, signals: Any, **fit_params: Any) -> Self:
        """Validate, whiten and unmix signals (n_samples, n_signals)."""
        signals, size = unmasked(signals), self.subspace_size
        limits = {"ensure_min_samples": 2, "ensure_min_features": size}
        signals = validate_data(self, signals, dtype=float, **limits)
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
    def _unmix(self, Z: NDArray, whitening: NDArray, *args: Any, **kw: Any) -> NDArray:
        """Return the orthogonal matrix that unmixes white Z (n_signals, n_samples).

        ``Z = whitening @ (signals - mean_).T``; both matrices are (n_signals,
        n_signals). Further arguments are those of `_fit_signals`.
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
    scale[scale <= OF_PRODUCTS * np.abs(centred).max(axis=0)] = 1.0
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
    W, n = W.copy(), len(W)
    n_iter, waited = np.zeros((2, n), dtype=int)
    running, converged = np.arange(n), np.zeros(n, dtype=bool)
    length, least_change = np.ones(n), np.full(n, np.inf)
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
            partners = np.nonzero(mates & ~itself)[1].reshape(n_signals, -1)
            with_b[a, b] = value(np.column_stack([partners[a], b]))
            mates_before = mates
            values = np.diag(with_b)
            gain = with_b - values[:, None]
            gain = np.where(mates, 0.0, gain + gain.T)
            pair = np.array(np.unravel_index(np.argmax(gain), gain.shape))
            if not gain[tuple(pair)] > OF_DIFFERENCES * np.abs(values).sum():
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
    """Return the values of subspaces in the mean log-likelihood of white signals.

    It is their sum ``sum_k E F(u_k)``, up to a constant.
    """
    square = signals**2

    def value(groups: NDArray) -> NDArray:
        values = np.empty(len(groups))
        for part in gen_batches(len(groups), 1 + 2**20 // square.shape[1]):
            energy = square[groups[part]].sum(axis=1)
            values[part] = log_density(energy).mean(axis=1)
        return values

    return value


# Starts that agree in the largest likelihood are enough:
# docs/benchmarks/README.md, "Thresholds".
AGREEING = 3


class FastISA(BaseSubspaceAnalysis):
    """
    Independent subspace analysis by fixed-point iteration from many starts.

    Finds a linear transformation of the signals into sources. Consecutive groups of
    `subspace_size` sources are as independent of each other as possible. Inside a
    group, the energies of the sources depend on each other.

    Each start takes a random orthogonal matrix, runs symmetric FastICA (subspaces of
    size one), groups its rows by greedy swaps and runs FastISA. The start with the
    largest likelihood is kept. The logarithm of the density of a subspace is
    ``-sqrt(u + 0.1)``, with its energy u, the squared norm of the point.

    Parameters
    ----------
    subspace_size : int, default=3
        Dimension of each subspace; the number of signals must be a multiple of it.
    n_init : int, default=30
        Maximum number of starts. Three starts, or six, are enough if three of them
        agree in the largest likelihood, up to a difference of `tol`.
    max_iter : int, default=500
        Maximum number of steps of each of the two iterations of a start.
    tol : float, default=1e-4
        Tolerance of both iterations: the largest change of a subspace, as the mean
        squared sine of the principal angles.
    random_state : int, RandomState instance or None, default=None
        Determines the random starts. Pass an int for reproducible results.
    n_jobs : int or None, default=None
        Number of joblib workers for the starts. The result does not depend on it.
    verbose : int, default=0
        If positive, print a line for each batch of starts.

    Attributes
    ----------
    components_ : ndarray of shape (n_signals, n_signals)
        Unmixing matrix, whitening included: ``(signals - mean_) @ components_.T`` are
        the sources. Sources are uncorrelated and have unit variance. Consecutive rows
        form a subspace. The matrix is orthogonal if the signals are white.
    mean_ : ndarray of shape (n_signals,)
        Mean of the signals.
    log_likelihood_ : float
        Mean log-likelihood per sample of the best start, up to a constant.
    log_likelihoods_ : ndarray of shape (n_starts,)
        The same for every start that was needed.
    n_iter_ : int
        Number of steps of the best start, in both iterations together.
    n_iters_ : ndarray of int, shape (n_starts,)
        The same for every start.
    n_features_in_ : int
        Number of signals.
    feature_names_in_ : ndarray of shape (n_signals,)
        Names of the signals. Defined only if all names are strings.

    See Also
    --------
    PooledFastICA : Independent components that are grouped afterwards.

    References
    ----------
    A. Hyvarinen, U. Koster, "FastISA: A fast fixed-point algorithm for independent
    subspace analysis", ESANN 2006.

    S. Brandt, H. Ackermann, S. Grasshof, "Uncalibrated Non-Rigid Factorisation by
    Independent Subspace Analysis", 2018, section 3.3.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.isa import FastISA
    >>> rng = np.random.default_rng(0)
    >>> sources = rng.normal(size=(2000, 2, 3)) * rng.exponential(size=(2000, 2, 1))
    >>> signals = sources.reshape(2000, 6) @ rng.normal(size=(6, 6))
    >>> isa = FastISA(n_init=5, random_state=0).fit(signals)
    >>> isa.components_.shape
    (6, 6)
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **BaseSubspaceAnalysis._parameter_constraints,
        "n_jobs": scikit_learn.N_JOBS,
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        subspace_size: int = 3,
        *,
        n_init: int = 30,
        max_iter: int = 500,
        tol: float = 1e-4,
        random_state: Any = None,
        n_jobs: int | None = None,
        verbose: int = 0,
    ):
        self.subspace_size = subspace_size
        self.n_init = n_init
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state
        self.n_jobs = n_jobs
        self.verbose = verbose

    @scikit_learn.fit_context(nested=False)
    def fit(self, signals: Any, y: Any = None) -> Self:
        """
        Find the independent subspaces.

        Parameters
        ----------
        signals : array-like of shape (n_samples, n_signals)
            The signals, one per column.
        y : None
            Ignored.

        Returns
        -------
        FastISA
            The fitted strategy.

        Raises
        ------
        ValueError
            If the number of signals is not a multiple of `subspace_size`, or the
            signals are linearly dependent.
        """
        return self._fit_signals(signals)

    def _unmix(self, Z: NDArray, whitening: NDArray) -> NDArray:
        normal = check_random_state(self.random_state).standard_normal
        starts = orthogonalise(normal((self.n_init, len(Z), len(Z))))
        # Few starts at first, as they often agree. Then batches that reduce overhead of
        # NumPy, with arrays that fit into the cache.
        ends = [AGREEING, 2 * AGREEING, *range(2 * AGREEING + 16, self.n_init, 16)]
        batches = [batch for batch in np.split(starts, ends) if len(batch)]
        results: list[Any] = []
        for group in filter(None, (batches[:1], batches[1:2], batches[2:])):
            n_jobs = min(effective_n_jobs(self.n_jobs), len(group))
            runs = (delayed(self._run)(batch, Z) for batch in group)
            for run in Parallel(n_jobs=n_jobs, return_as="generator")(runs):
                results.append(run)
                joined = map(np.concatenate, zip(*results, strict=True))
                W, log_likelihoods, n_iters, converged = joined
                highest = log_likelihoods.max()
                if self.verbose:
                    done = f"{len(W)}/{self.n_init} starts"
                    print(f"[FastISA] {done}, best {highest:.6g}")
            if np.sum(log_likelihoods > highest - self.tol) >= AGREEING:
                break
        best = int(np.argmax(log_likelihoods))
        if not converged[best]:
            warn_caller(
                f"FastISA did not converge in max_iter={self.max_iter} steps: its "
                "best start still changes. Increase max_iter or tol",
                ConvergenceWarning,
            )
        self.log_likelihoods_, self.log_likelihood_ = log_likelihoods, float(highest)
        self.n_iters_, self.n_iter_ = n_iters, int(n_iters[best])
        return W[best]

    def _run(self, starts: NDArray, Z: NDArray) -> tuple[NDArray, ...]:
        """Return unmixing, likelihood, steps, convergence of starts (n_batch, n, n)."""
        size, max_iter, tol = self.subspace_size, self.max_iter, self.tol
        # FastICA: subspaces of size one. Inside a subspace the components may be
        # undetermined, so a moderate convergence is enough.
        W, n_iter_ica, _ = iterate(starts, Z, 1, max_iter=max_iter, tol=max(tol, 1e-4))
        # Group the components into subspaces.
        in_order = np.arange(len(Z)) // size
        for r in range(len(W)):
            W[r] = W[r][swap_until_best([in_order], likelihoods(W[r] @ Z))[0]]
        # FastISA.
        W, n_iter, converged = iterate(W, Z, size, max_iter=max_iter, tol=tol)
        subspaces = np.arange(len(Z)).reshape(-1, size)
        values = np.array([likelihoods(each @ Z)(subspaces).sum() for each in W])
        return W, values, n_iter_ica + n_iter, converged


class PooledFastICA(BaseSubspaceAnalysis):
    """
    Independent subspace analysis by FastICA and pooling of its components.

    The independent components of scikit-learn's FastICA are pooled into groups of
    `subspace_size` by greedy pairwise swaps. If a covariance matrix over other data is
    given (for landmarks: over the images), the swaps make it as block-diagonal as
    possible. Otherwise they maximise the likelihood of independent subspaces.

    Parameters
    ----------
    subspace_size : int, default=3
        Dimension of each subspace; the number of signals must be a multiple of it.
    n_init : int, default=16
        Number of runs of FastICA from different starts. With few samples the runs end
        in different local optima. The best run by the criterion of `fit` is kept.
    max_iter : int, default=200
        Maximum number of steps of a run of FastICA.
    tol : float, default=1e-4
        Tolerance of FastICA.
    random_state : int, RandomState instance or None, default=None
        Determines the random starts. Pass an int for reproducible results.

    Attributes
    ----------
    components_ : ndarray of shape (n_signals, n_signals)
        Unmixing matrix, whitening included: ``(signals - mean_) @ components_.T`` are
        the sources. Sources are uncorrelated and have unit variance. Consecutive rows
        form a subspace. The matrix is orthogonal if the signals are white.
    mean_ : ndarray of shape (n_signals,)
        Mean of the signals.
    criteria_ : ndarray of shape (n_init,)
        Value of the criterion of `fit` for each run. The run with the largest value is
        kept.
    n_iter_ : int
        Steps of FastICA in the run that is kept.
    n_features_in_ : int
        Number of signals.
    feature_names_in_ : ndarray of shape (n_signals,)
        Names of the signals. Defined only if all names are strings.

    See Also
    --------
    FastISA : Independent subspaces by a fixed-point iteration.

    References
    ----------
    S. Brandt, H. Ackermann, S. Grasshof, "Uncalibrated Non-Rigid Factorisation by
    Independent Subspace Analysis", 2018, section 3.3.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.isa import PooledFastICA
    >>> rng = np.random.default_rng(0)
    >>> sources = rng.laplace(size=(1000, 6))
    >>> isa = PooledFastICA(n_init=3, random_state=0)
    >>> isa.fit(sources @ rng.normal(size=(6, 6))).components_.shape
    (6, 6)
    """

    def __init__(
        self,
        subspace_size: int = 3,
        *,
        n_init: int = 16,
        max_iter: int = 200,
        tol: float = 1e-4,
        random_state: Any = None,
    ):
        self.subspace_size = subspace_size
        self.n_init = n_init
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state

    @scikit_learn.fit_context(nested=False)
    def fit(
        self,
        signals: Any,
        y: Any = None,
        *,
        covariance: Any = None,
        criterion: Values | None = None,
    ) -> Self:
        """
        Find the independent components and pool them.

        Parameters
        ----------
        signals : array-like of shape (n_samples, n_signals)
            The signals, one per column.
        y : None
            Ignored.
        covariance : array-like of shape (n_signals, n_signals), default=None
            Symmetric covariance in the coordinates of the signals. The pooling
            minimises the energy of ``components_ @ covariance @ components_.T`` outside
            its diagonal blocks. If None, it maximises the likelihood of independent
            subspaces.
        criterion : callable, default=None
            Takes candidates for subspaces, ndarray of shape (n_candidates,
            subspace_size, n_signals) with rows of `components_`, and returns the value
            of each, ndarray of shape (n_candidates,). The run with the largest sum over
            its subspaces is kept. Its components are then swapped between subspaces as
            long as the sum rises. If None, the run with the best objective of the
            pooling is kept, without further swaps.

        Returns
        -------
        PooledFastICA
            The fitted strategy.

        Raises
        ------
        ValueError
            If the number of signals is not a multiple of `subspace_size`, the signals
            are linearly dependent, or `covariance` is not a symmetric matrix of shape
            (n_signals, n_signals).
        """
        return self._fit_signals(signals, covariance=covariance, criterion=criterion)

    def _unmix(
        self, Z: NDArray, whitening: NDArray, covariance: Any, criterion: Values | None
    ) -> NDArray:
        n_signals, size = len(Z), self.subspace_size
        if covariance is not None:
            covariance = _check_covariance(covariance, n_signals)
            covariance = whitening @ covariance @ whitening.T
            if not covariance.any():  # all groupings are as good
                covariance = np.eye(n_signals)
        random_state = check_random_state(self.random_state)
        starts = random_state.standard_normal((self.n_init, n_signals, n_signals))
        in_order = np.arange(n_signals) // size
        # Greedy swaps start from the components in order, and from random groupings.
        groupings = [in_order, *(random_state.permutation(in_order) for _ in range(7))]
        runs: list[tuple[float, NDArray, int, bool]] = []
        for start in starts:
            W, n_iter, converged = self._components(Z, start)
            if covariance is None:
                value = likelihoods(W @ Z)
            else:
                value = energy_shares(W @ covariance @ W.T)
            orders = swap_until_best(groupings, value)
            sums = [float(np.sum(value(rows.reshape(-1, size)))) for rows in orders]
            W, total = W[orders[int(np.argmax(sums))]], max(sums)
            if criterion is not None:
                subspaces = (W @ whitening).reshape(-1, size, n_signals)
                total = float(np.sum(criterion(subspaces)))
            runs.append((total, W, n_iter, converged))
        self.criteria_ = np.array([run[0] for run in runs])
        _, W, self.n_iter_, converged = runs[int(np.argmax(self.criteria_))]
        if criterion is not None:
            # All swaps between subspaces that raise the criterion
            found = W @ whitening
            W = W[swap_until_best([in_order], lambda each: criterion(found[each]))[0]]
        if not converged:
            warn_caller(
                f"{type(self).__name__} did not converge in max_iter={self.max_iter} "
                "steps in the run that is kept: its sources may be ill determined; try "
                "larger n_init or max_iter",
                ConvergenceWarning,
            )
        return W

    def _components(self, Z: NDArray, W: NDArray) -> tuple[NDArray, int, bool]:
        """Return unmixing, steps and convergence of one run on white signals.

        Z is (n_signals, n_samples), the start W (n_signals, n_signals).
        """
        # This imports all linear models, which `transform` does not need.
        from sklearn.decomposition import FastICA

        ica = FastICA(
            whiten=False, fun="exp", max_iter=self.max_iter, tol=self.tol, w_init=W
        )
        with warnings.catch_warnings(record=True, action="always") as caught:
            ica.fit(Z.T)
        converged = not any(w.category is ConvergenceWarning for w in caught)
        return polar(ica.components_)[0], ica.n_iter_, converged


def _check_covariance(covariance: Any, n_signals: int) -> NDArray:
    """Return a covariance matrix as an array, or raise an error."""
    covariance = check_array(covariance, dtype=np.float64, input_name="covariance")
    if covariance.shape != (n_signals, n_signals):
        raise ValueError(
            f"covariance must have shape {(n_signals, n_signals)}; "
            f"got {covariance.shape}"
        )
    if not np.allclose(covariance, covariance.T, atol=1e-8 * np.abs(covariance).max()):
        raise ValueError("covariance must be symmetric; got a matrix that is not")
    return covariance


def ready_strategy(
    isa: Any, joint: bool, random_state: Any, n_jobs: int | None, verbose: int
) -> Any:
    """Return the unfitted strategy, or the default one, with parameters that it lacks.

    `joint`: whether its result is only a start.
    """
    isa = PooledFastICA(n_init=2 if joint else 16) if isa is None else clone(isa)
    params = isa.get_params(deep=False)
    if params.get("subspace_size", 3) != 3:
        raise ValueError(
            "isa must have subspace_size=3, a dimension of space each; got "
            f"subspace_size={params['subspace_size']}"
        )
    if params.get("random_state", 0) is None:
        random_state = check_random_state(random_state)
        isa.set_params(random_state=random_state.randint(np.iinfo(np.int32).max))
    if params.get("n_jobs", 0) is None:
        isa.set_params(n_jobs=n_jobs)
    if params.get("verbose", 1) == 0:
        isa.set_params(verbose=verbose)
    return isa
