"""The choice of settings: AffineNRSfMCV and AutoNRSfM.

AffineNRSfMCV chooses the number of basis shapes by cross-validation along a path. All
frames are fitted with more and more basis shapes: each fit starts from the one before,
extended by the leading directions of its residuals. The fit of the rows of a split
starts from that of all frames with the same number of basis shapes.

AutoNRSfM chooses camera, refinement, loss, prior and K by held-out points. The first
fit has weak-perspective cameras and all directions of deformation, or the face prior if
a rough fit of a face has no depth. Each further one changes one setting, in the order
of its time, and is skipped where it cannot win. The consensus has the joint fit of the
best fit so far, orthographic cameras start from its shapes. Most fits have errors of
depths only if they are used.
"""

import contextlib
import copy
import time
import warnings
from collections.abc import Callable, Collection
from typing import Any, ClassVar, NamedTuple, Self

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

from isa_nrsfm import _parameters as choices
from isa_nrsfm._compat import scikit_learn
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import HasMethods, StrOptions
from isa_nrsfm._compat.texts import percent
from isa_nrsfm._estimator import AffineNRSfM, check_class
from isa_nrsfm._fitted_model import MOST_ROWS, fitted_prior, unexplained_share
from isa_nrsfm._joint import consensus
from isa_nrsfm._joint.settings import JOINT_TOL
from isa_nrsfm._linalg import centred, procrustes
from isa_nrsfm._parameters import JOINT_REFINEMENTS, named
from isa_nrsfm._prepare.scaling import scaled_table
from isa_nrsfm._tables import refuse_stored, spread
from isa_nrsfm.analysis import _advice as advice
from isa_nrsfm.datasets import load_face_prior
from isa_nrsfm.skeletons._column_names import names_of_points
from isa_nrsfm.skeletons._recognition import skeleton_in_images

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
            self._fit(X, point_weight, scikit_learn.NoProgress())
        self.unconverged = ConvergenceWarning in [each.category for each in caught]
        return self


class ChosenMixin(scikit_learn.CoefficientsMixin, TransformerMixin, MetaEstimatorMixin):
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


@scikit_learn.with_numpy_defaults
class AffineNRSfMCV(ChosenMixin, BaseEstimator):
    """
    `AffineNRSfM` with the number of basis shapes chosen by cross-validation.

    Each number of basis shapes is fitted to parts of the frames and scored on the
    others. These fits have no more directions of deformation, for calibrated cameras
    too. They form a path: each starts from an earlier one, which takes less than half
    the time of a plain search with `GridSearchCV`. Then the whole table is fitted with
    the chosen number, as by `AffineNRSfM`.

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
        "n_components": ["array-like", scikit_learn.AT_LEAST_ONE],
        "estimator": [None, HasMethods(["fit", "get_params", "set_params"])],
        "cv": ["cv_object"],
        "scoring": [None, str, callable],
        "select": [StrOptions({"best", "one_standard_error"})],
        "n_jobs": scikit_learn.N_JOBS,
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

    @scikit_learn.fit_context(nested=False)
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
        settings = estimator.get_params(deep=False)
        # No files of trials
        trial = StartedNRSfM(**settings | {"keep_frames": bool(estimator.keep_frames)})
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
        names = sorted(set(params) - ({"groups"} if method == "fit" else set()))
        if names:
            raise TypeError(
                f"{method} takes metadata {', '.join(names)} only with metadata "
                "routing: sklearn.set_config(enable_metadata_routing=True)"
            )
        return params, {}


def checked_candidates(n_components: Any) -> list[int]:
    """Return different numbers of basis shapes above zero in ascending order."""
    numbers = np.atleast_1d(np.asarray(n_components))
    candidates, whole = np.unique(numbers).tolist(), numbers.dtype.kind in "iu"
    different = numbers.ndim == 1 and len(candidates) == len(numbers) > 0
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
        rows = scikit_learn.taken_rows(X, train)
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
    scores = np.nan_to_num(results["mean_test_score"], nan=-np.inf)
    results["rank_test_score"] = rankdata(-scores, method="min").astype(np.int32)
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


AUTO = "auto"
# Components of the face prior: docs/depth.md has figures of nine and of forty.
FACE_COMPONENTS = 9
# Rows of rough fits, basis shapes of those that show whether depths are known, and of
# fits with perspective at most.
ROUGH_ROWS, ROUGH_SHAPES, MOST_SHAPES = 50, 2, 4
# All of these: docs/benchmarks/README.md, "Thresholds".
# Share of gross errors of held-out points above which robust losses are tried.
MOST_WRONG = 1e-3
# Largest variation of the scales of frames for which one scale is tried.
EQUAL_SCALES = 0.1
# Share of the deformation of groups of neighbours that must be rotations of their own.
OWN_ROTATIONS = 0.6
# Cameras are used if errors of held-out points fall by so many standard errors.
CLEAR = 2.0
# Other settings are used with errors that are at most so many times as large, those for
# depths if these are known better.
MOST_ERROR = {"loss": 0.97, "prior": np.inf, "refinement": 1.5}
FOR_DEPTH = ("prior", "refinement")


class Trial(NamedTuple):
    """
    A setting that was tried, or the reason why it was not.

    Attributes
    ----------
    setting : str
        What was tried: parameters that differ from those of the best fit before it.
    held_out_error : float
        As minus `AffineNRSfM.score`, of at most 300 rows; the median over points if the
        table has outliers. NaN if it was not fitted.
    depth_uncertainty : float
        As `AffineNRSfM.depth_uncertainty_`; NaN if it is not known.
    seconds : float
        Time of the fit.
    result : str
        "used", "less good", "not better", or the reason why it was not tried.
    """

    setting: str
    held_out_error: float
    depth_uncertainty: float
    seconds: float
    result: str

    def __repr__(self) -> str:
        """Return the trial in words."""
        if np.isnan(self.held_out_error):
            return f"{self.setting}: {self.result}"
        text = f"{self.setting}: {percent(self.held_out_error)} unexplained"
        if np.isfinite(self.depth_uncertainty):
            text += f", depth known to {percent(self.depth_uncertainty)}"
        return f"{text}, {self.result}"


@scikit_learn.with_numpy_defaults
class AutoNRSfM(ChosenMixin, BaseEstimator):
    """
    `AffineNRSfM` with the settings that held-out points of the table prefer.

    The first fit has weak-perspective cameras. Robust losses are tried if the table has
    outliers, orthographic cameras if all frames have one scale, affine ones if images
    are stretched, and perspective if the size of the images is known. If the depth is
    not determined or doubtful, the face prior is tried for layouts of faces (first, if
    a rough fit does not determine it), and then the consensus of groups of points. This
    is also tried for objects whose parts turn by themselves.

    Parameters
    ----------
    estimator : AffineNRSfM, default=None
        All other parameters, such as `random_state`. None is ``AffineNRSfM()``. A clone
        is fitted.
    n_components : int or "auto", default="auto"
        As in `AffineNRSfM`. Here and below, all but "auto" is kept.
    camera : str, default="auto"
        As in `AffineNRSfM`.
    refinement : str or None, default="auto"
        As in `AffineNRSfM`.
    loss : str, default="auto"
        As in `AffineNRSfM`.
    prior : AffineNRSfM, None or "auto", default="auto"
        As in `AffineNRSfM`. "auto" tries that of `isa_nrsfm.datasets.load_face_prior`.
    image_size : tuple of float (width, height), default=None
        Size of the images, in the units of the table. Perspective cameras and a focal
        length need it, unless the principal point is given.

    Attributes
    ----------
    best_estimator_ : AffineNRSfM
        The fit that is kept.
    n_components_ : int
        Its number of coefficients.
    trials_ : list of Trial
        What was tried, in order: held-out errors, errors of depths, and results.
    n_features_in_ : int
        Number of columns.
    feature_names_in_ : ndarray of shape (`n_features_in_`,)
        Names of the columns, where the table is a dataframe with string names.

    See Also
    --------
    AffineNRSfM : The fit with given settings.
    AffineNRSfMCV : The number of basis shapes by cross-validation.

    Examples
    --------
    >>> from isa_nrsfm import AutoNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> faces = make_face_tracks(n_frames=60, n_components=2, random_state=0)
    >>> auto = AutoNRSfM().fit(faces.data)
    >>> auto.n_components_, auto.best_estimator_.camera
    (2, 'weak_perspective')
    >>> auto.transform(faces.data).shape
    (60, 2)
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "estimator": [None, HasMethods(["fit", "get_params", "set_params"])],
        "n_components": AffineNRSfM._parameter_constraints["n_components"],
        "camera": [StrOptions({AUTO, *choices.CAMERA_NAMES})],
        "refinement": [StrOptions({AUTO, *choices.REFINEMENTS}), None],
        "loss": [StrOptions({AUTO, *choices.LOSSES})],
        "prior": [None, StrOptions({AUTO}), HasMethods(["fit", "get_params"])],
        "image_size": [None, "array-like"],
    }

    def __init__(
        self,
        estimator: Any = None,
        *,
        n_components: Any = AUTO,
        camera: str = AUTO,
        refinement: str | None = AUTO,
        loss: str = AUTO,
        prior: Any = AUTO,
        image_size: Any = None,
    ):
        self.estimator = estimator
        self.n_components = n_components
        self.camera = camera
        self.refinement = refinement
        self.loss = loss
        self.prior = prior
        self.image_size = image_size

    @scikit_learn.fit_context(nested=False)
    def fit(self, X: Any, y: Any = None, *, point_weight: Any = None) -> Self:
        """
        Fit a table with the settings that its held-out points prefer.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            The table, one frame a row, in memory or a memory map.
        y : None
            Ignored.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `AffineNRSfM.fit`.

        Returns
        -------
        AutoNRSfM
            The fitted estimator.

        Raises
        ------
        ValueError
            If the table is not in memory, or as in `AffineNRSfM.fit`.

        Warns
        -----
        UserWarning
            As in `AffineNRSfM.fit`, for the fit that is kept.
        """
        refuse_stored(X, "AutoNRSfM")
        estimator = AffineNRSfM() if self.estimator is None else self.estimator
        check_class(estimator, "estimator")
        given = {name: getattr(self, name) for name in FIRST}
        given = {n: v for n, v in given.items() if not isinstance(v, str) or v != AUTO}
        params, free = first_settings(given)
        estimator = clone(estimator).set_params(**params)
        point = None if self.image_size is None else np.divide(self.image_size, 2)
        near = estimator.camera == "perspective" or estimator.focal_length is not None
        if near and estimator.principal_point is None:
            estimator.set_params(principal_point=point)
        weights = {} if point_weight is None else {"point_weight": point_weight}
        self.best_estimator_, self.trials_ = decided(
            estimator, X, free, principal_point=point, **weights
        )
        self.n_components_ = self._n_features_out = self.best_estimator_.n_components_
        validate_data(self, X, skip_check_array=True)  # number and names of columns
        return self

    def score(self, X: Any, y: Any = None) -> float:
        """
        Return minus the inverse SNR of points held out of the fit of their frame.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        y : None
            Ignored.

        Returns
        -------
        float
            As in `AffineNRSfM.score`.
        """
        return self._fitted().score(X)


# Parameters of the first fit.
FIRST = {
    "n_components": AUTO,
    "camera": "weak_perspective",
    "refinement": "joint",
    "loss": "linear",
    "prior": None,
}


def first_settings(given: dict[str, Any]) -> tuple[dict[str, Any], set[str]]:
    """Return parameters of the first fit, and those that may change: none is given.

    A prior determines the camera and the refinement. Without the joint refinement
    nothing is compared.
    """
    params, free = FIRST | given, {*FIRST} - {*given}
    if params["refinement"] not in choices.JOINT_REFINEMENTS:
        return FIRST | {"n_components": 3, "camera": "affine"} | given, set()
    if params["prior"] is not None:
        camera = getattr(fitted_prior(params["prior"]), "camera_", params["camera"])
        params |= {"camera": given.get("camera", camera)}
        free -= {"camera", "refinement"}
    return params, free


class _Rows(NamedTuple):
    """Rows of a table on which fits are compared, their weights, what else is known."""

    X: Any
    weights: dict[str, Any]
    principal_point: Any
    face_layout: str

    def rough(self, params: dict[str, Any], **continued: Any) -> StartedNRSfM:
        """Return a fit of few rows."""
        sample = spread(np.arange(self.X.shape[0]), ROUGH_ROWS)
        model = StartedNRSfM(**params)
        model._continued = continued
        weights = {name: w[sample] for name, w in self.weights.items()}
        return model.fit(scikit_learn.taken_rows(self.X, sample), **weights)

    def held_out(self, model: AffineNRSfM) -> tuple[NDArray, float]:
        """Return squared errors and signals (n, J, 2) of held-out points, and optimism.

        That is the squared error of new frames over that of these.
        """
        table, weights = model._opened(self.X, **self.weights, judged=False)
        squares = np.asarray(table.joined(model._model.held_out, *weights))
        return squares, model._model.optimism(table, *weights)

    def own_rotations(self, model: AffineNRSfM) -> float:
        """Return the share of the deformation of groups that is their own rotation.

        It is that of groups of points that move together, as the consensus fits them.
        """
        S = model.reconstruct(self.X).mT
        S = S[np.isfinite(S).all(axis=(1, 2))]
        S = S[:, :, spread(np.arange(S.shape[2]), consensus.MOST_POINTS)]
        distances, before, left = consensus.neighbour_distances(S), 0.0, 0.0
        for points, count in consensus.neighbourhoods(distances, consensus.SMALLEST):
            part = centred(S[:, :, points])
            before += count * np.sum((part - part.mean(axis=0)) ** 2)
            for _ in range(3):  # to their mean
                part = procrustes(part.mean(axis=0) @ part.mT) @ part
            left += count * np.sum((part - part.mean(axis=0)) ** 2)
        return 1.0 - left / before if before > 0 else 0.0


class _Fit(NamedTuple):
    """A fit, its figures, warnings, and the errors with which others are compared."""

    model: AffineNRSfM
    trial: Trial
    caught: list[warnings.WarningMessage]
    squares: NDArray
    optimism: float

    def clearly_better(self, other: "_Fit", robust: bool) -> bool:
        """Return whether points of new frames have clearly smaller errors."""
        pairs = np.stack([f.optimism * f.squares[..., 0] for f in (other, self)])
        pairs = pairs[:, np.isfinite(pairs.sum(axis=0)).any(axis=1)]
        gain = np.subtract(*(np.nanmedian if robust else np.nanmean)(pairs, axis=2))
        return len(gain) > 0 and gain.mean() > CLEAR * gain.std() / np.sqrt(len(gain))

    def is_better(self, best: "_Fit", name: str, robust: bool) -> bool:
        """Return whether the fit is better than the best one, for what it changes."""
        if name == "camera":
            better = self.clearly_better(best, robust)
        else:
            limit = MOST_ERROR[name] * best.trial.held_out_error
            better = not self.trial.held_out_error > limit
        if name in FOR_DEPTH:
            better &= self.trial.depth_uncertainty < best.trial.depth_uncertainty
        return better

    @property
    def determined(self) -> bool:
        """Whether the depth is determined."""
        certainty = self.model._model.frames.certainty
        return bool(certainty.determined and self.model.camera != "affine")


# Each proposal: why a setting cannot win, otherwise the changes of the best fit.
Proposal = str | dict[str, Any]


def _robust_loss(best: _Fit, rows: _Rows) -> Proposal:
    """Outliers have their full influence on a fit with the linear loss."""
    if rows.weights:
        return "points have weights"
    # Fits with all directions of deformation follow outliers, held-out points cannot.
    if not advice.gross_residuals(np.sqrt(best.squares[..., 0]))[0] > MOST_WRONG:
        return "no outliers"
    return {"loss": "cauchy"}


def _perspective(best: _Fit, rows: _Rows) -> Proposal:
    """Fit few rows roughly, with a focal length too long for most cameras."""
    model, point = best.model, rows.principal_point
    if point is None:
        return "image size not known"
    near: dict[str, Any] = {"camera": "perspective"}
    near["principal_point"] = tuple(map(float, point))
    # More basis shapes would explain the perspective.
    cap = {"n_components": min(len(model.basis_), MOST_SHAPES)}
    near |= cap if model.n_components == AUTO else {}
    params = model.get_params(deep=False) | cap | {"prior": None, "refinement": "joint"}
    params |= near | {"focal_length": 5 * max(point)}
    seen = rows.rough(params).camera_ == "perspective"
    return near if seen else "held-out points do not show it"


def _frontal(estimator: AffineNRSfM, rows: _Rows) -> bool:
    """Return whether a rough fit, from the shapes of the face prior, has no depth.

    A known size of the images may determine it.
    """
    if rows.face_layout not in choices.FACE_PRIORS or rows.principal_point is not None:
        return False
    params = estimator.get_params(deep=False)
    if params["camera"] != "weak_perspective" or hasattr(estimator, "_model"):
        return False
    start = load_face_prior(ROUGH_SHAPES, layout=rows.face_layout)._model
    params |= {"n_components": ROUGH_SHAPES, "refinement": "joint"}
    try:
        rough = rows.rough(params, start=start, errors=True)
    except ValueError:  # such as points that too few of the rows show
        return False
    return not rough._model.frames.certainty.determined


def _face_prior(best: _Fit, rows: _Rows) -> Proposal:
    """The prior of faces supplies depths that a table does not determine."""
    if rows.face_layout not in choices.FACE_PRIORS:
        return "no layout of faces"
    if advice.known_depth(best.model):
        return "the depth is known"
    if best.model.camera != "weak_perspective":
        return f"not with {best.model.camera} cameras"
    return _with_face_prior(best.model, rows)


def _with_face_prior(model: AffineNRSfM, rows: _Rows) -> dict[str, Any]:
    """Return the parameters of a fit with the face prior."""
    K = FACE_COMPONENTS if model.n_components == AUTO else model.n_components
    return {"prior": load_face_prior(K, layout=rows.face_layout), "n_components": AUTO}


def _consensus(best: _Fit, rows: _Rows) -> Proposal:
    """Groups of points determine depths that all points together do not.

    They explain objects whose parts turn by themselves better.
    """
    if best.model.camera == "affine" or rows.weights:
        return "not with affine cameras or weights"
    cue = best.model.prior or best.model.camera == "perspective"
    known = advice.known_depth(best.model)
    if known and (cue or rows.own_rotations(best.model) < OWN_ROTATIONS):
        return "the depth is known"
    return {"refinement": "consensus"}


def _orthographic(best: _Fit, rows: _Rows) -> Proposal:
    """One scale for all frames has fewer unknowns."""
    model = best.model
    if model.camera != "weak_perspective" or model.prior or not best.determined:
        return "scales not known"
    if model.refinement != "joint":
        return "the fit has groups"
    if model.scales_.std() > EQUAL_SCALES * model.scales_.mean():
        return "scales differ"
    return {"camera": "orthographic"}


def _affine(best: _Fit, rows: _Rows) -> Proposal:
    """Affine cameras absorb the stretch of images."""
    if best.model.prior or not best.model.camera_noise_ratio_ >= advice.OTHER_CAMERAS:
        return "not stretched"
    plain = dict.fromkeys(("focal_length", "principal_point"))
    return {"camera": "affine", "refinement": "joint"} | plain


# What is tried, in this order: the parameter that changes, words, and the proposal.
PROPOSALS: tuple[tuple[str, str, Callable[..., Proposal]], ...] = (
    ("loss", "robust loss", _robust_loss),
    ("camera", "perspective", _perspective),
    ("prior", "face prior", _face_prior),
    ("camera", "affine", _affine),
    ("camera", "orthographic", _orthographic),
    ("refinement", "consensus", _consensus),
)


def decided(
    estimator: AffineNRSfM,
    X: Any,
    free: Collection[str],
    *,
    principal_point: Any = None,
    face_layout: str | None = None,
    show: Callable[[str], Any] = str,
    groups: Any = None,
    **weights: Any,
) -> tuple[AffineNRSfM, list[Trial]]:
    """Fit a table with the settings that its held-out points prefer.

    The estimator may be fitted already. `free` are the parameters that may change.
    Layouts of faces are recognised if None is given. `show` gets the names of trials;
    groups and weights are those of `AffineNRSfM.fit`.
    Returns the fit that is kept, with warnings, and what was tried.
    """
    sample = spread(np.arange(X.shape[0]), MOST_ROWS)
    row_weights = {name: np.asarray(each)[sample] for name, each in weights.items()}
    X_sample = scikit_learn.taken_rows(X, sample)
    layout = face_layout or ""
    if "prior" in free and not layout:
        layout = _layout_name(estimator, X_sample)
    rows = _Rows(X_sample, row_weights, principal_point, layout)

    def fitted(
        model: AffineNRSfM, setting: str, robust: bool, first: _Fit | None = None
    ) -> _Fit:
        """Return a fit and its trial. Figures may be those of a first fit."""
        since = time.perf_counter() - (first.trial.seconds if first else 0.0)
        with warnings.catch_warnings(record=True, action="always") as caught:
            if not hasattr(model, "_model"):
                model.fit(X, groups=groups, **weights)
        seconds = time.perf_counter() - since
        figures = first and (first.squares, first.optimism)
        squares, optimism = figures or rows.held_out(model)
        error = unexplained_share(squares, robust or model.loss != "linear")
        depth = float(getattr(model, "depth_uncertainty_", np.nan))
        trial = Trial(setting, error, depth, seconds, "used")
        return _Fit(model, trial, caught, squares, optimism)

    robust, trials = False, []
    setting = f"{estimator.camera.replace('_p', ' p')} cameras"
    best = None
    if "prior" in free and _frontal(estimator, rows):
        faces = clone(estimator).set_params(**_with_face_prior(estimator, rows))
        with contextlib.suppress(ValueError):  # such as other points than the prior's
            best = fitted(faces, "face prior", robust)
    if best is not None and best.determined:
        why = "a rough fit does not determine the depth"
        trials, free = [Trial(setting, np.nan, np.nan, 0.0, why)], {*free} - {"prior"}
    else:
        estimator._continued = {"known": {}}
        best = fitted(estimator, setting, robust)
    used = len(trials)
    trials.append(best.trial)
    for name, setting, proposal in PROPOSALS:
        if name not in free:
            continue
        changes = proposal(best, rows)
        if not isinstance(changes, str):
            show(setting)
            if name == "loss":  # outliers have no influence on medians
                robust, median = True, unexplained_share(best.squares, True)
                trials[used] = best.trial._replace(held_out_error=median)
                best = best._replace(trial=trials[used])
            try:
                found = fitted(_changed(best, name, changes), setting, robust)
            except ValueError as error:  # such as points that too few frames show
                changes = str(error)
        if isinstance(changes, str):
            trials.append(Trial(setting, np.nan, np.nan, 0.0, changes))
            continue
        better, continued = found.is_better(best, name, robust), found.model._continued
        if better and continued and not continued.get("errors", True):
            model = clone(found.model)
            model._continued = {"known": continued["known"]}
            found = fitted(model, setting, robust, found)
            if model.camera == "orthographic":  # compared with affine ones before
                model.camera_noise_ratio_ = best.model.camera_noise_ratio_
        trials.append(found.trial)
        if better:
            trials[used] = trials[used]._replace(result="less good")
            best, used = found, len(trials) - 1
        else:
            trials[-1] = found.trial._replace(result="not better")
    model = best.model
    if model.prior is not None:
        model.set_params(n_components=model.n_components_)
    for each in best.caught:  # made before the comparison
        warn_caller(str(each.message).replace(f". {advice.COMPARE}", ""), each.category)
    model._continued, model._trials = None, trials
    return model, trials


def _layout_name(estimator: AffineNRSfM, X: Any) -> str:
    """Return the name of the layout of a table, empty if it is not known."""
    plain = clone(estimator)
    try:
        with warnings.catch_warnings(action="ignore"):  # the fit warns
            tracks = plain._ready(X)[0].joined(np.asarray).mT
    except ValueError:  # the fit raises
        return ""
    names = names_of_points(plain, tracks.shape[1])
    return getattr(skeleton_in_images(tracks, names), "name", "")


def _changed(best: _Fit, name: str, changes: dict[str, Any]) -> AffineNRSfM:
    """Return the model with a change, which continues the best fit where it can."""
    model = clone(best.model).set_params(**changes)
    if name == "refinement":
        model._continued = best.model._continued
    elif model.camera == "perspective":
        model._continued = {"known": {"weak": best.model._model}}
    elif name not in FOR_DEPTH:
        model._continued = {"known": {}, "errors": False}
    if model.camera == "orthographic":
        model._continued = (model._continued or {}) | {"start": best.model._model}
    return model
