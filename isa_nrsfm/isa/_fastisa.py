"""FastISA with many starts: ISA1."""

from numbers import Integral
from typing import Any, ClassVar, Self

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state
from sklearn.utils.parallel import Parallel, delayed

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import HasMethods, fit_context
from isa_nrsfm.isa._base import (
    BaseSubspaceAnalysis,
    SqrtDensity,
    SubspaceDensity,
    iterate,
    likelihood_gains,
    log_likelihood,
    orthogonalise,
    rows_by_subspace,
    swap_until_best,
)


class FastISA(BaseSubspaceAnalysis):
    """
    Independent subspace analysis by fixed-point iteration from many starts.

    Finds a linear transformation of the signals into sources. Consecutive groups of
    `subspace_size` sources are as independent of each other as possible. Inside a
    group, the energies of the sources depend on each other.

    Each start takes a random orthogonal matrix, runs symmetric FastICA with the same
    density (subspaces of size one), groups its rows by greedy swaps and runs FastISA.
    The start with the largest likelihood is kept.

    Parameters
    ----------
    subspace_size : int, default=3
        Dimension of each subspace; the number of signals must be a multiple of it.
    n_init : int, default=30
        Number of starts.
    density : object, default=None
        Logarithm of the density of a subspace's energy, with the methods
        ``log_density(energy)`` and ``derivatives(energy)``; None is
        ``SqrtDensity(eps=0.1)``.
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
    log_likelihoods_ : ndarray of shape (n_init,)
        The same for every start.
    n_iter_ : int
        Number of steps of the best start, in both iterations together.
    n_iters_ : ndarray of int, shape (n_init,)
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
        "density": [None, HasMethods(["log_density", "derivatives"])],
        "n_jobs": [None, Integral],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        subspace_size: int = 3,
        *,
        n_init: int = 30,
        density: SubspaceDensity | None = None,
        max_iter: int = 500,
        tol: float = 1e-4,
        random_state: Any = None,
        n_jobs: int | None = None,
        verbose: int = 0,
    ):
        self.subspace_size = subspace_size
        self.n_init = n_init
        self.density = density
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state
        self.n_jobs = n_jobs
        self.verbose = verbose

    @fit_context(nested=False)
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
        density = SqrtDensity() if self.density is None else self.density
        random_state = check_random_state(self.random_state)
        n_signals = len(Z)
        starts = orthogonalise(
            random_state.standard_normal((self.n_init, n_signals, n_signals))
        )
        # Batches that reduce the overhead of NumPy, with arrays that fit into the
        # cache.
        batches = [starts[first : first + 16] for first in range(0, self.n_init, 16)]
        n_jobs = min(effective_n_jobs(self.n_jobs), len(batches))
        runs = Parallel(n_jobs=n_jobs, return_as="generator")(
            delayed(self._run)(batch, Z, density) for batch in batches
        )
        results = []
        for run in runs:
            results.append(run)
            if self.verbose:
                done = sum(len(W) for W, *_ in results)
                best = max(values.max() for _, values, *_ in results)
                print(f"[FastISA] {done}/{self.n_init} starts, best {best:.6g}")
        W, log_likelihoods, n_iters, converged = map(
            np.concatenate, zip(*results, strict=True)
        )
        best = int(np.argmax(log_likelihoods))
        if not converged[best]:
            warn_caller(
                f"FastISA did not converge in max_iter={self.max_iter} steps: its "
                "best start still changes. Increase max_iter or tol",
                ConvergenceWarning,
            )
        self.log_likelihoods_ = log_likelihoods
        self.log_likelihood_ = float(log_likelihoods[best])
        self.n_iters_ = n_iters
        self.n_iter_ = int(n_iters[best])
        return W[best]

    def _run(
        self, starts: NDArray, Z: NDArray, density: SubspaceDensity
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return unmixing, likelihood, steps, convergence of starts (n_batch, n, n)."""
        size, max_iter, tol = self.subspace_size, self.max_iter, self.tol
        # FastICA: subspaces of size one. Inside a subspace the components may be
        # undetermined, so a moderate convergence is enough.
        W, n_iter_ica, _ = iterate(
            starts, Z, 1, density, max_iter=max_iter, tol=max(tol, 1e-4)
        )
        # Group the components into subspaces.
        first = np.arange(len(Z)) // size
        for r in range(len(W)):
            assignment = swap_until_best(first, likelihood_gains(W[r] @ Z, density))
            W[r] = W[r][rows_by_subspace(assignment)]
        # FastISA.
        W, n_iter, converged = iterate(W, Z, size, density, max_iter=max_iter, tol=tol)
        return W, log_likelihood(W, Z, size, density), n_iter_ica + n_iter, converged
