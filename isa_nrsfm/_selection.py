"""AffineNRSfMCV: the number of basis shapes by cross-validation along a path.

All frames, and those that each split fits, are fitted with more and more basis shapes.
The fit of all frames starts from the one with fewer basis shapes, extended by the
leading directions of its residuals. The fit of a split starts from that of the same
frames with fewer basis shapes, and from the fit of all frames. The one with the lower
objective continues: held-out frames can contribute a start, but never select one.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from numbers import Integral
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata
from sklearn import get_config
from sklearn.base import BaseEstimator, MetaEstimatorMixin, TransformerMixin, clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.metrics import check_scoring
from sklearn.model_selection import check_cv
from sklearn.utils import get_tags, indexable
from sklearn.utils.metadata_routing import (
    UNUSED,
    MetadataRouter,
    MethodMapping,
    process_routing,
)
from sklearn.utils.parallel import Parallel, delayed
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.callbacks import NoProgress
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import (
    CoefficientNamesMixin,
    HasMethods,
    Interval,
    StrOptions,
    fit_context,
    number_of_rows,
    taken_rows,
)
from isa_nrsfm._estimator import AffineNRSfM, check_class
from isa_nrsfm._fit import JOINT_TOL, ready_table
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._tables.sources import StoredTable, is_on_dask

# Rows that are fitted, and rows that are held out.
Split = tuple[NDArray, NDArray]
# For held-out errors of 100 % and more.
NO_SHAPE = (
    "no number of basis shapes predicts held-out points better than the centroid of "
    "their frame does (an error of 100 %): the fitted frames share no shape with the "
    "others. Check that each column is the same point in all frames."
)


class PathFit(NamedTuple):
    """The fit of some rows: their model, score of held-out rows, seconds."""

    model: TableModel
    score: float
    fit_seconds: float
    score_seconds: float
    converged: bool


class PathStep(NamedTuple):
    """The fits with K basis shapes, of each split, and of all rows (one or none)."""

    n_components: int
    splits: list[PathFit]
    whole: list[PathFit]

    @property
    def scores(self) -> NDArray:
        """Scores (n_splits,) of held-out rows."""
        return np.array([fit.score for fit in self.splits])

    @property
    def n_unconverged(self) -> int:
        """Number of fits that did not converge."""
        return sum(not fit.converged for fit in self.splits + self.whole)

    def line(self, held_out: bool) -> str:
        """Return scores and time as text; a held-out error is minus the score."""
        mean, error = self.scores.mean(), standard_errors(self.scores)
        score = f"score {mean:.4g}, standard error {error:.2g}"
        if held_out:
            score = (
                f"held-out error {-100 * mean:.3g} %, standard error "
                f"{100 * error:.2g} %"
            )
        fits = self.splits + self.whole
        seconds = sum(fit.fit_seconds + fit.score_seconds for fit in fits)
        return f"n_components={self.n_components}: {score}, {seconds:.1f} s"


class AffineNRSfMCV(
    CoefficientNamesMixin, TransformerMixin, MetaEstimatorMixin, BaseEstimator
):
    """
    `AffineNRSfM` with the number of basis shapes chosen by cross-validation.

    Each number of basis shapes is fitted to parts of the frames and scored on the
    others. The fits form a path: each starts from earlier ones, which takes less than
    half the time of a plain search with `GridSearchCV`. Then the whole table is fitted
    with the chosen number, as by `AffineNRSfM`.

    Parameters
    ----------
    n_components : array-like of int, or int, default=(1, 2, 3, 4, 5, 6, 7, 8)
        The numbers of basis shapes to try, such as ``range(1, 9)``, in any order, or a
        single number. The path works best without large gaps.
    estimator : AffineNRSfM, default=None
        All other parameters, such as the camera; its `n_components` is not used. None
        is ``AffineNRSfM()``. A clone is fitted.
    cv : int, cross-validation generator or iterable, default=None
        Held-out frames. None for three blocks of rows, an int for as many blocks, a
        splitter such as ``GroupKFold()``, which holds out all frames of a person
        together, or an iterable of pairs (train, test) of row numbers. Blocks are not
        shuffled, because neighbours in a video are alike.
    scoring : str or callable, default=None
        A scorer of scikit-learn, ``scorer(estimator, X, y)``; larger is better. None is
        `AffineNRSfM.score`, which predicts points of the held-out frames from the other
        points of their frame.
    select : {"best", "one_standard_error"}, default="best"
        "best" takes the best mean score. "one_standard_error" takes the fewest basis
        shapes with a mean score at most one standard error below the best.
    n_jobs : int or None, default=None
        Number of parts of the table fitted at the same time, as in joblib.
    verbose : int, default=0
        Above zero, print a line for each number of basis shapes when it is done.

    Attributes
    ----------
    n_components_ : int
        The chosen number of basis shapes.
    best_estimator_ : AffineNRSfM
        The fit of all frames with `n_components_` basis shapes: the same as that of
        `AffineNRSfM` with this `n_components`.
    cv_results_ : dict of ndarrays
        For each number of basis shapes, ascending: `param_n_components`,
        ``split0_test_score`` and so on, `mean_test_score`, `std_test_score`,
        `rank_test_score`; the seconds `mean_fit_time`, `std_fit_time`,
        `mean_score_time`, `std_score_time` for each part, and `path_fit_time` of the
        fit of all frames from which others start; and `params`, a list.
    best_index_ : int
        The index of `n_components_` in the arrays of `cv_results_`.
    best_score_ : float
        The mean score of `n_components_`.
    refit_time_ : float
        Seconds of the fit of `best_estimator_`.
    scorer_ : callable
        The scorer.
    n_splits_ : int
        The number of parts that are held out in turn.
    n_features_in_ : int
        Number of columns.
    feature_names_in_ : ndarray of shape (`n_features_in_`,)
        Names of the columns, where the table is a dataframe with string names.

    See Also
    --------
    AffineNRSfM : The fit for a given number of basis shapes; its `n_components="auto"`
        chooses without frames that are held out.

    Notes
    -----
    The table is checked, centred and scaled once. A fit of all frames starts from the
    previous one: from its shapes and the leading directions of the residuals. The fit
    of a part of the frames starts from the fit of all frames, and from the previous fit
    of the same part. The one with the lower objective on that part continues until it
    has converged; the other is dropped before. Held-out frames can contribute a start,
    but have no other influence on the score. ``python -m benchmarks.choice`` compares
    errors and choices with those of a plain search.

    With ``refinement="consensus"`` the search compares joint fits. Only the chosen K is
    fitted with the consensus. With ``refinement="alternating"`` or None no fit can
    start from another one. The search is then a plain one.

    Where metadata routing is enabled, `fit` passes metadata on to the splitter and the
    scorer, and `score` to the scorer. `groups` go to the splitter in any case.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfMCV
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> tracks = make_nonrigid_tracks(90, 25, 2, noise=0.01, random_state=0)
    >>> search = AffineNRSfMCV(range(1, 4), cv=3).fit(tracks.data)
    >>> search.n_components_
    2
    >>> search.transform(tracks.data).shape
    (90, 2)
    """

    n_components_: int
    best_estimator_: AffineNRSfM
    cv_results_: dict[str, Any]
    best_index_: int
    best_score_: float
    refit_time_: float
    scorer_: Any
    n_splits_: int
    feature_names_in_: NDArray

    # `groups` go to the splitter, not to this estimator.
    __metadata_request__fit: ClassVar[dict[str, str]] = {"groups": UNUSED}

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": ["array-like", Interval(Integral, 1, None, closed="left")],
        "estimator": [None, HasMethods(["fit", "get_params", "set_params"])],
        "cv": ["cv_object"],
        "scoring": [None, str, callable],
        "select": [StrOptions({"best", "one_standard_error"})],
        "n_jobs": [None, Integral],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        n_components: Any = (1, 2, 3, 4, 5, 6, 7, 8),
        *,
        estimator: Any = None,
        cv: Any = None,
        scoring: Any = None,
        select: str = "best",
        n_jobs: int | None = None,
        verbose: int = 0,
    ):
        self.n_components = n_components
        self.estimator = estimator
        self.cv = cv
        self.scoring = scoring
        self.select = select
        self.n_jobs = n_jobs
        self.verbose = verbose

    @fit_context(nested=False)
    def fit(self, X: Any, y: Any = None, **params: Any) -> Self:
        """
        Choose the number of basis shapes, and fit the table with it.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            The table, one frame a row, in memory or a memory map.
        y : array-like of shape (n_frames,), default=None
            Only for the splitter and the scorer.
        **params : dict
            `groups` for the splitter, an array-like of shape (n_frames,); other
            metadata if metadata routing is enabled.

        Returns
        -------
        AffineNRSfMCV
            The fitted estimator.

        Raises
        ------
        ValueError
            If `n_components` are not different whole numbers above zero, if the table
            or a part of it that is fitted does not allow the largest of them, if it is
            not in memory, if no score is a number, or in any case in which
            `AffineNRSfM.fit` raises.
        TypeError
            If there are other metadata than `groups`, and metadata routing is not
            enabled.

        Warns
        -----
        UserWarning
            As in `AffineNRSfM.fit`, and if fits of the path have not converged or all
            held-out errors are above 100 %.
        """
        estimator = self._estimator()
        candidates = checked_candidates(self.n_components)
        refuse_blocks(X)
        X, y = indexable(X, y)
        routed = self._routed("fit", params)
        scorer = self._scorer()
        splits = [
            (np.asarray(train), np.asarray(held_out))
            for train, held_out in self._splitter().split(X, y, **routed["splitter"])
        ]
        trial = clone(estimator).set_params(frames_folder=None)
        if trial.refinement == "consensus":  # only of the chosen K
            trial.set_params(refinement="joint")
        if self.scoring is None and trial.refinement == "joint":
            trial.set_params(independence=None)  # which the score does not depend on
        check_rows(trial, X, splits, candidates[-1])
        metadata = routed["scorer"]
        score = partial(held_out_score, scorer=scorer, X=X, y=y, params=metadata)
        path = []
        for step in path_steps(trial, X, candidates, splits, score, self.n_jobs):
            path.append(step)
            if self.verbose:
                text = step.line(held_out=self.scoring is None)
                print(f"[{type(self).__name__}] {text}", flush=True)
        warn_of_unconverged(path)
        results = results_of(path)
        best = selected(np.array([step.scores for step in path]), self.select)
        if self.scoring is None and np.nanmax(results["mean_test_score"]) <= -1:
            warn_caller(NO_SHAPE)
        since = time.perf_counter()
        fitted = estimator.set_params(n_components=candidates[best]).fit(X)
        self.refit_time_ = time.perf_counter() - since
        self.best_estimator_, self.scorer_ = fitted, scorer
        self.cv_results_, self.n_splits_ = results, len(splits)
        self.best_index_, self.n_components_ = best, candidates[best]
        self.best_score_ = float(results["mean_test_score"][best])
        if hasattr(fitted, "feature_names_in_"):
            self.feature_names_in_ = fitted.feature_names_in_
        elif hasattr(self, "feature_names_in_"):
            del self.feature_names_in_
        return self

    def fit_transform(self, X: Any, y: Any = None, **params: Any) -> NDArray:
        """
        Choose the number of basis shapes, and return the coefficients of the frames.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            The table.
        y : array-like of shape (n_frames,), default=None
            As in `fit`.
        **params : dict
            As in `fit`.

        Returns
        -------
        ndarray of shape (n_frames, `n_components_`)
            The coefficients.
        """
        fitted = self.fit(X, y, **params).best_estimator_
        return fitted.alpha_.copy() if fitted.keep_frames else fitted.transform(X)

    def transform(self, X: Any) -> NDArray:
        """
        Return the coefficients of the frames of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, `n_components_`)
            As in `AffineNRSfM.transform`.
        """
        check_is_fitted(self)
        return self.best_estimator_.transform(X)

    def inverse_transform(
        self, alpha: Any, motion: Any = None, translation: Any = None
    ) -> NDArray:
        """
        Return the table of shapes with given coefficients.

        Parameters
        ----------
        alpha : array-like of shape (n_frames, `n_components_`)
            Coefficients.
        motion : array-like of shape (n_frames, 2, 3) or (2, 3), default=None
            Cameras, as in `AffineNRSfM.inverse_transform`.
        translation : array-like of shape (n_frames, 2) or (2,), default=None
            Positions, as in `AffineNRSfM.inverse_transform`.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            The table.
        """
        check_is_fitted(self)
        return self.best_estimator_.inverse_transform(alpha, motion, translation)

    def decompose(self, X: Any) -> Decomposition:
        """
        Return camera and coefficients of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        Decomposition
            As in `AffineNRSfM.decompose`.
        """
        check_is_fitted(self)
        return self.best_estimator_.decompose(X)

    def reconstruct(self, X: Any, camera: str | None = None) -> NDArray:
        """
        Return the 3D shape of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        camera : {"orthographic", "weak_perspective"} or None, default=None
            As in `AffineNRSfM.reconstruct`.

        Returns
        -------
        ndarray of shape (n_frames, n_points, 3)
            As in `AffineNRSfM.reconstruct`.
        """
        check_is_fitted(self)
        return self.best_estimator_.reconstruct(X, camera)

    def reproject(self, X: Any) -> NDArray:
        """
        Return the images of the fitted shapes, including missing points.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            As in `AffineNRSfM.reproject`.
        """
        check_is_fitted(self)
        return self.best_estimator_.reproject(X)

    def score(self, X: Any, y: Any = None, **params: Any) -> float:
        """
        Return the score of `best_estimator_` on a table, by `scoring`.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        y : array-like of shape (n_frames,), default=None
            Only for the scorer.
        **params : dict
            Metadata for the scorer, if metadata routing is enabled.

        Returns
        -------
        float
            The score; larger is better.
        """
        check_is_fitted(self)
        routed = self._routed("score", params)
        return float(self.scorer_(self.best_estimator_, X, y, **routed["scorer"]))

    @property
    def n_features_in_(self) -> int:
        """Number of columns of the fitted table."""
        try:
            check_is_fitted(self)
        except ValueError as error:
            name = type(self).__name__
            raise AttributeError(f"{name} has no n_features_in_ before fit") from error
        return self.best_estimator_.n_features_in_

    @property
    def _n_features_out(self) -> int:
        """Number of columns of the result of `transform`."""
        return self.n_components_

    def get_metadata_routing(self) -> MetadataRouter:
        """
        Return the metadata routing of this object.

        Returns
        -------
        MetadataRouter
            From `fit` to the splitter and the scorer, from `score` to the scorer.
        """
        fit, split, score = (
            MethodMapping().add(caller="fit", callee=callee)
            for callee in ("fit", "split", "score")
        )
        score.add(caller="score", callee="score")
        router = MetadataRouter(owner=self)
        router.add(estimator=self._estimator(), method_mapping=fit)
        router.add(splitter=self._splitter(), method_mapping=split)
        return router.add(scorer=self._scorer(), method_mapping=score)

    def __sklearn_tags__(self) -> Any:
        """Return the tags of the estimator that is fitted."""
        tags, inner = super().__sklearn_tags__(), get_tags(self._estimator())
        tags.transformer_tags.preserves_dtype = inner.transformer_tags.preserves_dtype
        tags.input_tags.allow_nan = inner.input_tags.allow_nan
        return tags

    def __sklearn_is_fitted__(self) -> bool:
        """Return whether a fit has ended."""
        return hasattr(self, "best_estimator_")

    def _estimator(self) -> AffineNRSfM:
        """Return the estimator to be fitted."""
        estimator = AffineNRSfM() if self.estimator is None else self.estimator
        check_class(estimator, "estimator")
        copied: AffineNRSfM = clone(estimator)
        return copied

    def _scorer(self) -> Any:
        """Return the scorer of fitted estimators."""
        return check_scoring(self._estimator(), self.scoring)

    def _splitter(self) -> Any:
        """Return the splitter of the rows of a table."""
        # More blocks cost more, and hardly change the choice. Neighbours are alike:
        # large blocks keep them together.
        return check_cv(3 if self.cv is None else self.cv)

    def _routed(self, method: str, params: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the metadata for the splitter and the scorer."""
        if get_config().get("enable_metadata_routing"):
            routed = process_routing(self, method, **params)
            splitter = routed.splitter.split if method == "fit" else {}
            return {"splitter": splitter, "scorer": routed.scorer.score}
        others = sorted(set(params) - ({"groups"} if method == "fit" else set()))
        if others:
            raise TypeError(
                f"{method} takes metadata {', '.join(others)} only with metadata "
                "routing: sklearn.set_config(enable_metadata_routing=True)"
            )
        return {"splitter": params, "scorer": {}}


def checked_candidates(n_components: Any) -> list[int]:
    """Return different numbers of basis shapes above zero in ascending order."""
    given = np.atleast_1d(np.asarray(n_components))
    if given.ndim != 1 or not len(given) or given.dtype.kind not in "iu":
        raise ValueError(
            "n_components must be numbers of basis shapes, such as range(1, 9); got "
            f"{n_components!r}"
        )
    candidates = sorted(given.tolist())
    if candidates[0] < 1 or len(set(candidates)) < len(candidates):
        raise ValueError(
            "n_components must be different numbers of at least 1; got "
            f"{n_components!r}"
        )
    return candidates


def refuse_blocks(X: Any) -> None:
    """Raise an error if the rows of a table cannot be taken one by one."""
    if is_on_dask(X) or isinstance(X, StoredTable):
        raise ValueError(
            "choosing n_components needs a table in memory or a memory map; got a "
            f"{type(X).__name__}: take some thousand of its frames"
        )


def held_out_score(
    model: AffineNRSfM, held_out: NDArray, scorer: Any, X: Any, y: Any, params: Any
) -> float:
    """Return the score of a fitted estimator on held-out rows of X and y.

    Metadata `params` with an entry for each row are split in the same way.
    """
    n_rows = number_of_rows(X)
    own = {
        name: taken_rows(value, held_out)
        if hasattr(value, "__len__") and len(value) == n_rows
        else value
        for name, value in params.items()
    }
    y = None if y is None else taken_rows(y, held_out)
    return float(scorer(model, taken_rows(X, held_out), y, **own))


def check_rows(
    estimator: AffineNRSfM, X: Any, splits: Sequence[Split], n_components: int
) -> None:
    """Refuse a table, or rows that a split fits, not enough for K basis shapes."""

    def check(rows: Any, k: int) -> None:
        table = clone(estimator).set_params(n_components=k)
        with warnings.catch_warnings(action="ignore"):  # the last fit warns
            source, weights, settings = table._ready(rows)
            ready_table(source, weights, k, settings)

    def allowed(rows: Any, k: int) -> bool:
        try:
            check(rows, k)
        except ValueError:
            return False
        return True

    check(X, n_components)
    for number, (train, _) in enumerate(splits):
        rows = taken_rows(X, train)
        try:
            check(rows, n_components)
        except ValueError as error:
            fewer = (k for k in range(n_components - 1, 0, -1) if allowed(rows, k))
            raise ValueError(
                f"split {number} of cv fits {len(train)} frames, enough for "
                f"n_components={next(fewer, 0)} at most: {error}"
            ) from error


def path_steps(
    estimator: AffineNRSfM,
    X: Any,
    candidates: Sequence[int],
    splits: Sequence[Split],
    score: Callable[[AffineNRSfM, NDArray], float],
    n_jobs: int | None,
) -> Iterator[PathStep]:
    """Yield the fits of all rows and of each split, for ascending numbers of shapes.

    `n_jobs` splits are fitted at a time. Without the joint refinement no fit starts
    from another one, and the fit of all rows is left out.
    """
    joint = estimator.refinement == "joint"
    # Fits of all frames are only starts: their tolerance is larger.
    tol = JOINT_TOL if estimator.tol is None else estimator.tol
    loose = clone(estimator).set_params(tol=4.0 * tol)
    before: list[list[TableModel]] = [[] for _ in range(len(splits) + 1)]
    with Parallel(n_jobs=n_jobs) as parallel:
        for k in candidates:
            whole = [fitted_rows(loose, X, k, before[0])] if joint else []
            starts = [fit.model for fit in whole]
            fits = parallel(
                delayed(fitted_rows)(estimator, X, k, [*own, *starts], split, score)
                for split, own in zip(splits, before[1:], strict=True)
            )
            yield PathStep(k, fits, whole)
            if joint:
                before = [[fit.model] for fit in (*whole, *fits)]


def fitted_rows(
    estimator: AffineNRSfM,
    X: Any,
    n_components: int,
    starts: Sequence[TableModel],
    split: Split | None = None,
    score: Callable[[AffineNRSfM, NDArray], float] | None = None,
) -> PathFit:
    """Return the fit of all rows, or of a split and its score, from given starts."""
    since = time.perf_counter()
    model = clone(estimator).set_params(n_components=n_components)
    # The last fit warns.
    with warnings.catch_warnings(record=True, action="ignore") as unconverged:
        warnings.simplefilter("always", ConvergenceWarning)
        rows = X if split is None else taken_rows(X, split[0])
        model._fit(rows, None, NoProgress(), starts=starts)
        between = time.perf_counter()
        value = np.nan if split is None or score is None else score(model, split[1])
    seconds = between - since, time.perf_counter() - between
    return PathFit(model._model, value, *seconds, not unconverged)


def results_of(path: Sequence[PathStep]) -> dict[str, Any]:
    """Return `cv_results_` of `AffineNRSfMCV`, as in `GridSearchCV`."""
    scores = np.array([step.scores for step in path])
    mean = scores.mean(axis=1)
    results: dict[str, Any] = {
        "param_n_components": np.array([step.n_components for step in path]),
        "params": [{"n_components": step.n_components} for step in path],
        **{f"split{i}_test_score": column for i, column in enumerate(scores.T)},
        "mean_test_score": mean,
        "std_test_score": scores.std(axis=1),
        # Unknown scores rank last.
        "rank_test_score": rankdata(
            -np.nan_to_num(mean, nan=-np.inf), method="min"
        ).astype(np.int32),
        "path_fit_time": np.array(
            [sum(fit.fit_seconds for fit in step.whole) for step in path]
        ),
    }
    for name in ("fit", "score"):
        seconds = np.array(
            [[getattr(fit, f"{name}_seconds") for fit in step.splits] for step in path]
        )
        results[f"mean_{name}_time"] = seconds.mean(axis=1)
        results[f"std_{name}_time"] = seconds.std(axis=1)
    return results


def selected(scores: NDArray, select: str) -> int:
    """Return the index of the chosen number of basis shapes.

    Scores are (n_candidates, n_splits), by ascending number of basis shapes. "best"
    takes the best mean. "one_standard_error" takes the fewest basis shapes with a mean
    at most one standard error below the best (Hastie, Tibshirani, Friedman, "The
    elements of statistical learning", 2009, section 7.10).
    """
    mean = scores.mean(axis=1)
    if np.isnan(mean).all():
        raise ValueError(
            "n_components cannot be chosen by held-out points: too few points are "
            "visible. Give n_components, or take frames with more visible points"
        )
    best = int(np.nanargmax(mean))
    if select == "best":
        return best
    n_splits = scores.shape[1]
    if n_splits < 2:
        raise ValueError(
            f"select={select!r} needs the standard error over at least two splits; cv "
            "has one"
        )
    error = standard_errors(scores)[best]
    return int(np.argmax(mean >= mean[best] - error))


def standard_errors(scores: NDArray) -> NDArray:
    """Return the standard errors of mean scores (..., n_splits); NaN with one split."""
    n_splits = scores.shape[-1]
    if n_splits < 2:
        return np.full(scores.shape[:-1], np.nan)
    return np.asarray(scores.std(axis=-1, ddof=1) / np.sqrt(n_splits))


def warn_of_unconverged(path: Sequence[PathStep]) -> None:
    """Warn if fits of a path did not converge."""
    which = [str(step.n_components) for step in path if step.n_unconverged]
    if which:
        n_fits = sum(step.n_unconverged for step in path)
        warn_caller(
            f"not all fits converged while n_components was chosen: {n_fits} with "
            f"n_components of {', '.join(which)} did not. Increase max_iter or tol",
            ConvergenceWarning,
        )
