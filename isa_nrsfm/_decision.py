"""AutoNRSfM: camera, refinement, loss, prior and K that held-out points prefer.

The first fit has weak-perspective cameras and all directions of deformation. Each
further one changes one setting, in the order of its time, and is skipped where it
cannot win. The consensus has the joint fit of the best fit so far, orthographic cameras
start from its shapes. Most fits have errors of depths only if they are used.
"""

import time
import warnings
from collections.abc import Callable, Collection
from functools import partial
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone
from sklearn.utils.validation import validate_data

from isa_nrsfm import _parameters as choices
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import (
    HasMethods,
    StrOptions,
    fit_context,
    taken_rows,
    with_numpy_defaults,
)
from isa_nrsfm._compat.texts import percent
from isa_nrsfm._estimator import AffineNRSfM, check_class
from isa_nrsfm._fitted_model import MOST_ROWS, fitted_prior, unexplained_share
from isa_nrsfm._joint import consensus
from isa_nrsfm._linalg import centred, procrustes
from isa_nrsfm._selection import ChosenMixin, StartedNRSfM
from isa_nrsfm._tables.blocks import refuse_stored, spread
from isa_nrsfm.analysis._advice import (
    COMPARE,
    OTHER_CAMERAS,
    gross_residuals,
    layout_of,
)
from isa_nrsfm.datasets import load_face_prior

AUTO = "auto"
# Components of the face prior: docs/depth.md has figures of nine and of forty.
FACE_COMPONENTS = 9
# Rows of rough fits, and basis shapes of fits with perspective, at most.
ROUGH_ROWS, MOST_SHAPES = 50, 4
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


@with_numpy_defaults
class AutoNRSfM(ChosenMixin, BaseEstimator):
    """
    `AffineNRSfM` with the settings that held-out points of the table prefer.

    The first fit has weak-perspective cameras. Robust losses are tried if the table has
    outliers, orthographic cameras if all frames have one scale, affine ones if images
    are stretched, and perspective if the size of the images is known. If the depth is
    not determined, the face prior is tried for layouts of faces, and then the consensus
    of groups of points, which is also tried for objects whose parts turn by themselves.

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

    @fit_context(nested=False)
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
        known = estimator.camera == "perspective" or estimator.focal_length is not None
        if known and estimator.principal_point is None:
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
    face_layout: str | None

    def squares(self, model: AffineNRSfM) -> NDArray:
        """Return squared errors and signals (n, J, 2) of held-out points."""
        table, weights = model._opened(self.X, **self.weights, judged=False)
        return np.asarray(table.joined(model._model.held_out, *weights))

    def own_rotations(self, model: AffineNRSfM) -> float:
        """Return the share of the deformation of groups that is their own rotation.

        It is that of groups of points that move together, as the consensus fits them.
        """
        S = model.reconstruct(self.X).mT
        S = S[np.isfinite(S).all(axis=(1, 2))]
        some = spread(np.arange(S.shape[2]), consensus.MOST_POINTS)
        distances, before, left = consensus.neighbour_distances(S[:, :, some]), 0.0, 0.0
        for points, count in consensus.neighbourhoods(distances, consensus.SMALLEST):
            part = centred(S[:, :, some[points]])
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

    def clearly_better(self, other: "_Fit", robust: bool) -> bool:
        """Return whether held-out points of frames have clearly smaller errors."""
        pairs = np.stack([other.squares[..., 0], self.squares[..., 0]])
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
        known = self.model._model.frames.certainty.determined
        return bool(known and self.model.camera != "affine")


# Each proposal: why a setting cannot win, otherwise the changes of the best fit.
Proposal = str | dict[str, Any]


def _robust_loss(best: _Fit, rows: _Rows) -> Proposal:
    """Outliers have their full influence on a fit with the linear loss."""
    if rows.weights:
        return "points have weights"
    # Fits with all directions of deformation follow outliers, held-out points cannot.
    if not gross_residuals(np.sqrt(best.squares[..., 0]))[0] > MOST_WRONG:
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
    few = {"n_components": min(len(model.basis_), MOST_SHAPES)}
    near |= few if model.n_components == AUTO else {}
    params = model.get_params(deep=False) | few | {"prior": None, "refinement": "joint"}
    params |= near | {"focal_length": 5 * max(point)}
    some = spread(np.arange(rows.X.shape[0]), ROUGH_ROWS)
    X, weights = taken_rows(rows.X, some), {n: w[some] for n, w in rows.weights.items()}
    seen = StartedNRSfM(**params).fit(X, **weights).camera_ == "perspective"
    return near if seen else "held-out points do not show it"


def _face_prior(best: _Fit, rows: _Rows) -> Proposal:
    """The prior of faces supplies depths that a table does not determine."""
    layout, K = rows.face_layout, best.model.n_components
    layout = layout or getattr(layout_of(best.model), "name", None)
    if layout not in choices.FACE_PRIORS:
        return "no layout of faces"
    if best.determined:
        return "the depth is known"
    if best.model.camera != "weak_perspective":
        return f"not with {best.model.camera} cameras"
    prior = load_face_prior(FACE_COMPONENTS if K == AUTO else K, layout=layout)
    return {"prior": prior, "n_components": AUTO}


def _consensus(best: _Fit, rows: _Rows) -> Proposal:
    """Groups of points determine depths that all points together do not.

    They explain objects whose parts turn by themselves better.
    """
    if best.model.camera == "affine" or rows.weights:
        return "not with affine cameras or weights"
    known = best.model.prior or best.model.camera == "perspective"
    if best.determined and (known or rows.own_rotations(best.model) < OWN_ROTATIONS):
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
    ratio = best.model.camera_noise_ratio_
    if best.model.prior or not ratio >= OTHER_CAMERAS:
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
    some = spread(np.arange(X.shape[0]), MOST_ROWS)
    few = {name: np.asarray(each)[some] for name, each in weights.items()}
    rows = _Rows(taken_rows(X, some), few, principal_point, face_layout)
    fitted = partial(_fitted, X, {"groups": groups, **weights}, rows)
    robust, used, estimator._continued = False, 0, {"known": {}}
    best = fitted(estimator, f"{estimator.camera.replace('_p', ' p')} cameras", robust)
    trials = [best.trial]
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
        warn_caller(str(each.message).replace(f". {COMPARE}", ""), each.category)
    model._continued, model._trials = None, trials
    return model, trials


def _fitted(
    X: Any,
    given: dict[str, Any],
    rows: _Rows,
    model: AffineNRSfM,
    setting: str,
    robust: bool,
    first: _Fit | None = None,
) -> _Fit:
    """Return the fit of a model, and its trial. Figures may be those of a first fit."""
    since = time.perf_counter() - (first.trial.seconds if first else 0.0)
    with warnings.catch_warnings(record=True, action="always") as caught:
        if not hasattr(model, "_model"):
            model.fit(X, **given)
    seconds = time.perf_counter() - since
    squares = first.squares if first else rows.squares(model)
    error = unexplained_share(squares, robust or model.loss != "linear")
    depth = float(getattr(model, "depth_uncertainty_", np.nan))
    trial = Trial(setting, error, depth, seconds, "used")
    return _Fit(model, trial, caught, squares)


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
