"""FastICA whose components are pooled into subspaces: ISA2."""

import warnings
from collections.abc import Callable
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_array, check_random_state

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import Interval, StrOptions, fit_context
from isa_nrsfm.isa._base import BaseSubspaceAnalysis
from isa_nrsfm.isa._density import SqrtDensity
from isa_nrsfm.isa._fixed_point import log_likelihood, orthogonalise
from isa_nrsfm.isa._grouping import (
    covariance_gains,
    likelihood_gains,
    rows_by_subspace,
    swap_until_best,
    value_gains,
)

# Number of groupings from which the greedy swaps start. The first takes the components
# in order, the others are random.
N_GROUPINGS = 8

Criterion = Callable[[NDArray], NDArray]


class PooledFastICA(BaseSubspaceAnalysis):
    """
    Independent subspace analysis by FastICA and pooling of its components.

    The independent components of scikit-learn's FastICA are pooled into groups of
    `subspace_size` by greedy pairwise swaps, such that a covariance matrix over other
    data (for landmarks: over the images) becomes as block-diagonal as possible, or
    without one such that the likelihood of independent subspaces is largest.

    Parameters
    ----------
    subspace_size : int, default=3
        Dimension of each subspace; the number of signals must be a multiple of it.
    n_init : int, default=16
        Number of runs of FastICA from different starts. With few samples the runs end
        in different places; the best by the criterion of `fit` is kept.
    fun : {"exp", "logcosh", "cube"}, default="exp"
        Contrast function of FastICA.
    max_iter : int, default=200
        The most steps of a run of FastICA.
    tol : float, default=1e-4
        Tolerance of FastICA.
    random_state : int, RandomState instance or None, default=None
        Draws the starts; an int makes the result reproducible.

    Attributes
    ----------
    components_ : ndarray of shape (n_signals, n_signals)
        Unmixing matrix, whitening included: ``(signals - mean_) @ components_.T`` are
        the sources, uncorrelated with unit variance; consecutive rows form a
        subspace. Orthogonal when the signals are white already.
    mean_ : ndarray of shape (n_signals,)
        Mean of the signals.
    criteria_ : ndarray of shape (n_init,)
        Value of each run by the criterion of `fit`. The run of largest value is kept.
    n_iter_ : int
        Steps of FastICA in the run that is kept.
    n_features_in_ : int
        Number of signals.
    feature_names_in_ : ndarray of shape (n_signals,)
        Names of the signals, where they came in a dataframe with string names.

    See Also
    --------
    FastISA : Subspaces by a fixed-point iteration of their own.

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

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **BaseSubspaceAnalysis._parameter_constraints,
        "fun": [StrOptions({"exp", "logcosh", "cube"})],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="neither")],
    }

    def __init__(
        self,
        subspace_size: int = 3,
        *,
        n_init: int = 16,
        fun: str = "exp",
        max_iter: int = 200,
        tol: float = 1e-4,
        random_state: Any = None,
    ):
        self.subspace_size = subspace_size
        self.n_init = n_init
        self.fun = fun
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state

    @fit_context(nested=False)
    def fit(
        self,
        signals: Any,
        y: Any = None,
        *,
        covariance: Any = None,
        criterion: Criterion | None = None,
    ) -> Self:
        """
        Find the independent components and pool them.

        Parameters
        ----------
        signals : array-like of shape (n_samples, n_signals)
            The signals, one a column.
        y : None
            Ignored.
        covariance : array-like of shape (n_signals, n_signals), default=None
            Symmetric, in the coordinates of the signals: the sources are pooled such
            that ``components_ @ covariance @ components_.T`` has least energy outside
            its diagonal blocks. Without it they are pooled by the likelihood of
            independent subspaces.
        criterion : callable, default=None
            Takes candidates for subspaces, ndarray of shape (n_candidates,
            subspace_size, n_signals) with rows of `components_`, and returns the value
            of each, ndarray of shape (n_candidates,). The run with the largest sum
            over its subspaces is kept, and its components change places between
            subspaces as long as that raises the sum. None keeps the run that is best
            by the objective of the pooling, as pooled.

        Returns
        -------
        PooledFastICA
            The fitted strategy.

        Raises
        ------
        ValueError
            If the number of signals is not a multiple of `subspace_size`, the signals
            are linearly dependent, or `covariance` is not a symmetric matrix of theirs.
        """
        return self._fit(signals, covariance=covariance, criterion=criterion)

    def _unmix(
        self,
        Z: NDArray,
        whitening: NDArray,
        *,
        covariance: Any = None,
        criterion: Criterion | None = None,
    ) -> NDArray:
        n_signals = len(Z)
        if covariance is not None:
            covariance = _check_covariance(covariance, n_signals)
            covariance = whitening @ covariance @ whitening.T
        random_state = check_random_state(self.random_state)
        starts = random_state.standard_normal((self.n_init, n_signals, n_signals))
        in_order = np.arange(n_signals) // self.subspace_size
        groupings = [in_order] + [
            random_state.permutation(in_order) for _ in range(N_GROUPINGS - 1)
        ]
        runs: list[tuple[float, NDArray, int, bool]] = []
        for start in starts:
            W, n_iter, converged = self._fastica(Z, start)
            if covariance is None:
                W, value = _pool_by_likelihood(W, Z, groupings, self.subspace_size)
            else:
                W, value = _pool_by_covariance(W, W @ covariance @ W.T, groupings)
            if criterion is not None:
                rows = (W @ whitening).reshape(-1, self.subspace_size, n_signals)
                value = float(np.sum(criterion(rows)))
            runs.append((value, W, n_iter, converged))
        self.criteria_ = np.array([run[0] for run in runs])
        _, W, n_iter, converged = runs[int(np.argmax(self.criteria_))]
        self.n_iter_ = n_iter
        if criterion is not None:
            W = _regroup(W, W @ whitening, in_order, criterion)
        if not converged:
            warn_caller(
                f"FastICA did not converge in max_iter={self.max_iter} steps in the "
                "run that is kept: its sources may be ill determined; try "
                "PooledFastICA with another fun or larger n_init or max_iter",
                ConvergenceWarning,
            )
        return W

    def _fastica(self, Z: NDArray, start: NDArray) -> tuple[NDArray, int, bool]:
        """Return unmixing, steps and convergence of one run on white signals."""
        # With it come all linear models, for which `transform` need not wait.
        from sklearn.decomposition import FastICA

        ica = FastICA(
            whiten=False,
            fun=self.fun,
            max_iter=self.max_iter,
            tol=self.tol,
            w_init=start,
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            ica.fit(Z.T)
        converged = not any(w.category is ConvergenceWarning for w in caught)
        return orthogonalise(ica.components_[None])[0], ica.n_iter_, converged


def _check_covariance(covariance: Any, n_signals: int) -> NDArray:
    """Return a covariance matrix as an array, or say what is wrong with it."""
    covariance = check_array(covariance, dtype=np.float64, input_name="covariance")
    if covariance.shape != (n_signals, n_signals):
        raise ValueError(
            f"covariance must have shape {(n_signals, n_signals)}; "
            f"got {covariance.shape}"
        )
    if not np.allclose(covariance, covariance.T, atol=1e-8 * np.abs(covariance).max()):
        raise ValueError("covariance must be symmetric; got a matrix that is not")
    return covariance


def _pool_by_covariance(
    W: NDArray, covariance: NDArray, groupings: list[NDArray]
) -> tuple[NDArray, float]:
    """Return the rows of W by subspaces, and the share of energy inside the blocks.

    W and the covariance of its signals are (n_signals, n_signals), each grouping is
    (n_signals,).
    """
    gains = covariance_gains(covariance)
    energy = covariance**2
    total = float(energy.sum())

    def inside(assignment: NDArray) -> float:
        return float(energy[assignment[:, None] == assignment].sum())

    pooled = max((swap_until_best(first, gains) for first in groupings), key=inside)
    return W[rows_by_subspace(pooled)], inside(pooled) / total if total > 0 else 1.0


def _pool_by_likelihood(
    W: NDArray, Z: NDArray, groupings: list[NDArray], subspace_size: int
) -> tuple[NDArray, float]:
    """Return the rows of W by subspaces, and the log-likelihood.

    W is (n_signals, n_signals), Z (n_signals, n_samples), each grouping (n_signals,).
    """
    density = SqrtDensity()
    gains = likelihood_gains(W @ Z, density)

    def likelihood(rows: NDArray) -> float:
        return float(log_likelihood(W[rows], Z, subspace_size, density))

    pooled = [swap_until_best(first, gains) for first in groupings]
    rows = max((rows_by_subspace(a) for a in pooled), key=likelihood)
    return W[rows], likelihood(rows)


def _regroup(
    W: NDArray, components: NDArray, assignment: NDArray, criterion: Criterion
) -> NDArray:
    """Return the rows of W after all swaps between subspaces that raise the criterion.

    W is orthogonal, `components` is W with the whitening, which the criterion takes.
    Both are (n_signals, n_signals), the assignment (n_signals,).
    """

    def value(groups: NDArray) -> NDArray:
        return criterion(components[groups])

    gains = value_gains(value, len(W))
    return W[rows_by_subspace(swap_until_best(assignment, gains))]
