"""AffineNRSfMCV: the number of basis shapes by cross-validation along a path."""

import time
from functools import partial
from numbers import Integral
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn import get_config
from sklearn.base import BaseEstimator, MetaEstimatorMixin, TransformerMixin, clone
from sklearn.metrics import check_scoring
from sklearn.model_selection import check_cv
from sklearn.utils import get_tags, indexable
from sklearn.utils.metadata_routing import (
    UNUSED,
    MetadataRouter,
    MethodMapping,
    process_routing,
)
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.scikit_learn import (
    HasMethods,
    Interval,
    StrOptions,
    fit_context,
    number_of_rows,
    taken_rows,
)
from isa_nrsfm._estimator import AffineNRSfM, check_class
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._selection.choice import (
    SELECTIONS,
    line,
    results_of,
    selected,
    warn_of_no_shape,
    warn_of_unconverged,
)
from isa_nrsfm._selection.path import ready_part, walk
from isa_nrsfm._tables.sources import StoredTable, is_on_dask
from isa_nrsfm._transformer import CoefficientNamesMixin


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
        "select": [StrOptions(set(SELECTIONS))],
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
        table = ready_part(estimator, X, candidates[-1])
        splits = [
            (np.asarray(train), np.asarray(held_out))
            for train, held_out in self._splitter().split(X, y, **routed["splitter"])
        ]
        rows = []
        for row in walk(
            table,
            candidates,
            splits,
            partial(held_out_score, scorer=scorer, X=X, y=y, params=routed["scorer"]),
            any_basis=self.scoring is None,
            n_jobs=self.n_jobs,
        ):
            rows.append(row)
            if self.verbose:
                print(
                    f"[{type(self).__name__}] {line(row, self.scoring is None)}",
                    flush=True,
                )
        warn_of_unconverged(rows)
        scores = np.array([row.scores for row in rows])
        best = selected(scores, self.select)
        if self.scoring is None:
            warn_of_no_shape(scores)
        since = time.perf_counter()
        fitted = estimator.set_params(n_components=candidates[best]).fit(X)
        self.refit_time_ = time.perf_counter() - since
        self.best_estimator_, self.scorer_ = fitted, scorer
        self.cv_results_, self.n_splits_ = results_of(rows), len(splits)
        self.best_index_, self.n_components_ = best, candidates[best]
        self.best_score_ = float(self.cv_results_["mean_test_score"][best])
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
