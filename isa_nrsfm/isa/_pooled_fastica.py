"""FastICA whose components are pooled into subspaces: ISA2."""

import warnings
from collections.abc import Callable
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_array, check_random_state

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import StrOptions, fit_context
from isa_nrsfm.isa._base import (
    BaseSubspaceAnalysis,
    Gains,
    SqrtDensity,
    covariance_gains,
    likelihood_gains,
    log_likelihood,
    orthogonalise,
    rows_by_subspace,
    swap_until_best,
    value_gains,
)

Criterion = Callable[[NDArray], NDArray]


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
    fun : {"exp", "logcosh", "cube"}, default="exp"
        Contrast function of FastICA.
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

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **BaseSubspaceAnalysis._parameter_constraints,
        "fun": [StrOptions({"exp", "logcosh", "cube"})],
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
        # Greedy swaps start from the components in order, and from random groupings.
        groupings = [in_order, *(random_state.permutation(in_order) for _ in range(7))]
        runs: list[tuple[float, NDArray, int, bool]] = []
        for start in starts:
            W, n_iter, converged = self._components(Z, start)
            gains, value_of = _objective(W, Z, covariance, in_order)
            swapped = [swap_until_best(first, gains) for first in groupings]
            rows = max(map(rows_by_subspace, swapped), key=value_of)
            value, W = value_of(rows), W[rows]
            if criterion is not None:
                subspaces = (W @ whitening).reshape(-1, self.subspace_size, n_signals)
                value = float(np.sum(criterion(subspaces)))
            runs.append((value, W, n_iter, converged))
        self.criteria_ = np.array([run[0] for run in runs])
        _, W, n_iter, converged = runs[int(np.argmax(self.criteria_))]
        self.n_iter_ = n_iter
        if criterion is not None:
            # All swaps between subspaces that raise the criterion
            components = W @ whitening
            gains = value_gains(lambda groups: criterion(components[groups]), n_signals)
            W = W[rows_by_subspace(swap_until_best(in_order, gains))]
        if not converged:
            other = "another fun or " if "fun" in self.get_params() else ""
            warn_caller(
                f"{type(self).__name__} did not converge in max_iter={self.max_iter} "
                "steps in the run that is kept: its sources may be ill determined; try "
                f"{other}larger n_init or max_iter",
                ConvergenceWarning,
            )
        return W

    def _components(self, Z: NDArray, start: NDArray) -> tuple[NDArray, int, bool]:
        """Return unmixing, steps and convergence of one run on white signals.

        Z is (n_signals, n_samples), start and unmixing (n_signals, n_signals).
        """
        # This imports all linear models, which `transform` does not need.
        from sklearn.decomposition import FastICA

        ica = FastICA(
            whiten=False,
            fun=self.fun,
            max_iter=self.max_iter,
            tol=self.tol,
            w_init=start,
        )
        with warnings.catch_warnings(record=True, action="always") as caught:
            ica.fit(Z.T)
        converged = not any(w.category is ConvergenceWarning for w in caught)
        return orthogonalise(ica.components_[None])[0], ica.n_iter_, converged


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


def _objective(
    W: NDArray, Z: NDArray, covariance: NDArray | None, in_order: NDArray
) -> tuple[Gains, Callable[[NDArray], float]]:
    """Return the gains of swaps of rows of W, and the value of the rows in an order.

    The share of energy of the covariance inside the blocks, or the log-likelihood.
    """
    if covariance is None:
        density, size = SqrtDensity(), int(np.count_nonzero(in_order == 0))
        return (
            likelihood_gains(W @ Z, density),
            lambda rows: float(log_likelihood(W[rows], Z, size, density)),
        )
    pooled = W @ covariance @ W.T
    energy, inside = pooled**2, in_order[:, None] == in_order
    total = float(energy.sum())

    def share(rows: NDArray) -> float:
        return float(energy[np.ix_(rows, rows)][inside].sum()) / total if total else 1.0

    return covariance_gains(pooled), share
