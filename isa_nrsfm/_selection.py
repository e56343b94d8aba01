"""AffineNRSfMCV: the number of basis shapes by cross-validation along a path.

All frames are fitted with more and more basis shapes: each fit starts from the one
before, extended by the leading directions of its residuals. The fit of the rows of a
split starts from that of all frames with the same number of basis shapes.
"""

import copy
import time
import warnings
from numbers import Integral
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata
from sklearn import get_config
from sklearn.base import BaseEstimator, MetaEstimatorMixin, TransformerMixin, clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.metrics import check_scoring
from sklearn.model_selection import GridSearchCV, check_cv, cross_validate
from sklearn.utils import indexable
from sklearn.utils.metadata_routing import UNUSED, MetadataRouter, process_routing
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import (
    N_JOBS,
    CoefficientsMixin,
    HasMethods,
    Interval,
    NoProgress,
    StrOptions,
    fit_context,
    taken_rows,
    with_numpy_defaults,
)
from isa_nrsfm._estimator import AffineNRSfM, check_class
from isa_nrsfm._joint.settings import JOINT_TOL
from isa_nrsfm._parameters import JOINT_REFINEMENTS, named
from isa_nrsfm._prepare.scaling import scaled_table
from isa_nrsfm._tables.blocks import refuse_stored

# For held-out errors of 100 % and more.
NO_SHAPE = (
    "no number of basis shapes predicts held-out points better than the centroid of "
    "their frame does (an error of 100 %): the fitted frames share no shape with the "
    "others. Check that each column is the same point in all frames."
)


class StartedNRSfM(AffineNRSfM):
    """A fit that starts from another one, without warnings and errors of depths."""

    def __sklearn_clone__(self) -> Self:
        """Return a copy with the same start."""
        return copy.copy(self)

    def fit(
        self, X: Any, y: Any = None, *, point_weight: Any = None, groups: Any = None
    ) -> Self:
        """Fit a table, and remember whether the fit has not converged."""
        # Held-out points compare numbers of basis shapes.
        self._continued = {"whole": False, "errors": False} | (self._continued or {})
        with warnings.catch_warnings(record=True, action="always") as caught:
            self._fit(X, point_weight, NoProgress())
        self.unconverged = ConvergenceWarning in [each.category for each in caught]
        return self


class ChosenMixin(CoefficientsMixin, TransformerMixin, MetaEstimatorMixin):
    """Methods of an estimator that keeps the best of several fits."""

    best_estimator_: AffineNRSfM

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
        return self._fitted().transform(X)

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
        return self._fitted().inverse_transform(alpha, motion, translation)

    def _fitted(self) -> AffineNRSfM:
        """Return the fit of all frames, or raise if there is none."""
        check_is_fitted(self)
        return self.best_estimator_


@with_numpy_defaults
class AffineNRSfMCV(ChosenMixin, BaseEstimator):
    """
    `AffineNRSfM` with the number of basis shapes chosen by cross-validation.

    Each number of basis shapes is fitted to parts of the frames and scored on the
    others. The fits form a path: each starts from an earlier one, which takes less than
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
    A fit of all frames starts from the previous one: from its shapes and the leading
    directions of the residuals. The fit of a part of the frames starts from the fit of
    all frames with the same number of basis shapes. Held-out frames contribute to this
    start, but have no other influence on the score. ``python -m benchmarks.choice``
    compares errors and choices with those of a plain search.

    With ``refinement="consensus"`` the search compares joint fits. Only the chosen K is
    fitted with the consensus. With ``refinement="alternating"`` or None no fit can
    start from another one. The search is then a plain one.

    Where metadata routing is enabled, `fit` passes metadata on to the splitter and the
    scorer, and `score` to the scorer. `groups` go to the splitter in any case.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfMCV
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> tracks = make_nonrigid_tracks(40, 20, 2, noise=0.01, random_state=0)
    >>> search = AffineNRSfMCV([1, 2, 3], cv=2).fit(tracks.data)
    >>> search.n_components_
    2
    >>> search.transform(tracks.data).shape
    (40, 2)
    """

    # `groups` go to the splitter, not to this estimator.
    __metadata_request__fit: ClassVar[dict[str, str]] = {"groups": UNUSED}

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": ["array-like", Interval(Integral, 1, None, closed="left")],
        "estimator": [None, HasMethods(["fit", "get_params", "set_params"])],
        "cv": ["cv_object"],
        "scoring": [None, str, callable],
        "select": [StrOptions({"best", "one_standard_error"})],
        "n_jobs": N_JOBS,
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
        plain, candidates = self._plain_search(), checked_candidates(self.n_components)
        estimator, scorer = plain.estimator, plain.scoring
        refuse_stored(X, "choosing n_components")
        X, y = indexable(X, y)
        for_splitter, for_scorer = self._routed("fit", params)
        splits = list(plain.cv.split(X, y, **for_splitter))
        given = estimator.get_params(deep=False) | {"frames_folder": None}
        trial = StartedNRSfM(**given)
        joint = trial.refinement in JOINT_REFINEMENTS
        if joint:  # a consensus only with the chosen K
            trial.set_params(refinement="joint")
        if self.scoring is None and joint:  # the score does not depend on the basis
            trial.set_params(independence=None)
        check_rows(trial, X, [train for train, _ in splits], candidates[-1])
        # Fits of all frames are only starts: their tolerance is larger.
        tol = 4.0 * (JOINT_TOL if trial.tol is None else trial.tol)
        whole = copy.copy(trial).set_params(tol=tol)
        parts, n_unconverged = [], []
        validation = {"cv": splits, "scoring": scorer, "params": for_scorer}
        validation |= {"return_estimator": True, "error_score": "raise"}
        for k in candidates:
            since = time.perf_counter()
            if joint:
                whole.set_params(n_components=k).fit(X)
                whole._continued = trial._continued = {"start": whole._model}
            seconds = joint * (time.perf_counter() - since)
            trial.set_params(n_components=k)
            part = cross_validate(trial, X, y, n_jobs=self.n_jobs, **validation)
            fits = part.pop("estimator") + [whole] * joint
            n_unconverged.append(sum(fit.unconverged for fit in fits))
            parts.append(part | {"path_time": seconds})
            if self.verbose:
                seconds += sum(part["fit_time"] + part["score_time"])
                text = line(k, part["test_score"], self.scoring is None)
                print(f"[{type(self).__name__}] {text}, {seconds:.1f} s", flush=True)
        if which := [str(candidates[i]) for i in np.flatnonzero(n_unconverged)]:
            warn_caller(
                f"not all fits converged while {named('n_components')} was chosen: "
                f"{sum(n_unconverged)} with {named('n_components')} of "
                f"{', '.join(which)} did not. Increase max_iter or tol",
                ConvergenceWarning,
            )
        self.cv_results_ = results_of(candidates, parts)
        scores = np.array([part["test_score"] for part in parts])
        best = selected(scores, self.select)
        if self.scoring is None and np.nanmax(scores.mean(axis=1)) <= -1:
            warn_caller(NO_SHAPE)
        since = time.perf_counter()
        estimator.set_params(n_components=candidates[best])
        self.best_estimator_, self.scorer_ = estimator.fit(X), scorer
        self.refit_time_ = time.perf_counter() - since
        self.best_index_, self.n_splits_ = best, len(splits)
        self.n_components_ = self._n_features_out = candidates[best]
        self.best_score_ = float(scores[best].mean())
        validate_data(self, X, skip_check_array=True)  # number and names of columns
        return self

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
        estimator, (_, for_scorer) = self._fitted(), self._routed("score", params)
        return float(self.scorer_(estimator, X, y, **for_scorer))

    def get_metadata_routing(self) -> MetadataRouter:
        """
        Return the metadata routing of this object.

        Returns
        -------
        MetadataRouter
            From `fit` to the splitter and the scorer, from `score` to the scorer.
        """
        return self._plain_search().get_metadata_routing()

    def _plain_search(self) -> GridSearchCV:
        """Return a search with a clone of the estimator, its scorer and splitter."""
        estimator = AffineNRSfM() if self.estimator is None else self.estimator
        check_class(estimator, "estimator")
        if estimator.prior is not None:
            raise ValueError(
                "a fit with a prior has as many basis shapes as the prior: there is no "
                "n_components to choose. Set prior=None, or fit the estimator itself"
            )
        estimator, scorer = clone(estimator), check_scoring(estimator, self.scoring)
        # More blocks cost more, and hardly change the choice. Neighbours are alike:
        # large blocks keep them together.
        cv = check_cv(3 if self.cv is None else self.cv)
        return GridSearchCV(estimator, {}, scoring=scorer, cv=cv)

    def _routed(self, method: str, params: dict[str, Any]) -> tuple[Any, Any]:
        """Return the metadata for the splitter and for the scorer."""
        if get_config()["enable_metadata_routing"]:
            routed = process_routing(self, method, **params)
            return routed.splitter.get("split", {}), routed.scorer.score
        others = sorted(set(params) - ({"groups"} if method == "fit" else set()))
        if others:
            raise TypeError(
                f"{method} takes metadata {', '.join(others)} only with metadata "
                "routing: sklearn.set_config(enable_metadata_routing=True)"
            )
        return params, {}


def checked_candidates(n_components: Any) -> list[int]:
    """Return different numbers of basis shapes above zero in ascending order."""
    given = np.atleast_1d(np.asarray(n_components))
    candidates, whole = np.unique(given).tolist(), given.dtype.kind in "iu"
    different = given.ndim == 1 and len(candidates) == len(given) > 0
    if not (whole and different and candidates[0] > 0):
        raise ValueError(
            "n_components must be numbers of basis shapes, such as range(1, 9), "
            f"different numbers of at least 1; got {n_components!r}"
        )
    return candidates


def check_rows(
    estimator: AffineNRSfM, X: Any, splits: list[NDArray], n_components: int
) -> None:
    """Refuse a table, or rows of it that are fitted, not enough for K basis shapes."""

    def refused(rows: Any, k: int) -> ValueError | None:
        with warnings.catch_warnings(action="ignore"):  # the last fit warns
            try:
                source, weights, settings = clone(estimator)._ready(rows)
                scaled_table(source, weights, k, settings)
            except ValueError as error:
                return error
        return None

    if error := refused(X, n_components):
        raise error
    for number, train in enumerate(splits):
        rows = taken_rows(X, train)
        if error := refused(rows, n_components):
            fewer = (k for k in range(n_components)[:0:-1] if not refused(rows, k))
            raise ValueError(
                f"split {number} of cv fits {len(train)} frames, enough for "
                f"{named('n_components', next(fewer, 0))} at most: {error}"
            ) from error


def results_of(candidates: list[int], parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return `cv_results_` as in `GridSearchCV`, from results of `cross_validate`."""
    results: dict[str, Any] = {
        "param_n_components": np.array(candidates),
        "params": [{"n_components": k} for k in candidates],
        "path_fit_time": np.array([part["path_time"] for part in parts]),
    }
    for name in ("fit_time", "score_time", "test_score"):
        values = np.array([part[name] for part in parts])
        results |= {f"mean_{name}": values.mean(axis=1)}
        results |= {f"std_{name}": values.std(axis=1)}
    # Of the scores. Unknown ones rank last.
    results |= {f"split{i}_{name}": column for i, column in enumerate(values.T)}
    known = np.nan_to_num(results["mean_test_score"], nan=-np.inf)
    results["rank_test_score"] = rankdata(-known, method="min").astype(np.int32)
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
            f"{named('n_components')} cannot be chosen by held-out points: too few "
            f"points are visible. Give {named('n_components')}, or take frames with "
            "more visible points"
        )
    best = int(np.nanargmax(mean))
    if select == "best":
        return best
    if scores.shape[1] < 2:
        raise ValueError(
            f"select={select!r} needs the standard error over at least two splits; cv "
            "has one"
        )
    return int(np.argmax(mean >= mean[best] - standard_errors(scores)[best]))


def standard_errors(scores: NDArray) -> NDArray:
    """Return the standard errors of mean scores (..., n_splits); NaN with one split."""
    n_splits = scores.shape[-1]
    if n_splits < 2:
        return np.full(scores.shape[:-1], np.nan)
    return np.asarray(scores.std(axis=-1, ddof=1) / np.sqrt(n_splits))


def line(n_components: int, scores: NDArray, held_out: bool) -> str:
    """Return scores (n_splits,) as text; a held-out error is minus the score."""
    mean, error = scores.mean(), standard_errors(scores)
    text = f"score {mean:.4g}, standard error {error:.2g}"
    if held_out:
        text = f"held-out error {-100 * mean:.3g} %, standard error {100 * error:.2g} %"
    return f"{named('n_components', n_components)}: {text}"
