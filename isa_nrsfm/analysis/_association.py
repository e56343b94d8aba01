"""Association of coefficients with a label: a class or a number for each frame."""

from numbers import Integral
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.stats import rankdata
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import (
    GroupKFold,
    KFold,
    StratifiedGroupKFold,
    StratifiedKFold,
    cross_val_score,
)
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils import check_array, check_random_state, check_scalar

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.texts import aligned
from isa_nrsfm._linalg import OF_DIFFERENCES
from isa_nrsfm.analysis import _frame_columns, _permutations


class Association(NamedTuple):
    """
    Association of each coefficient with a label.

    Attributes
    ----------
    kind : {"classes", "number"}
        Kind of the labels.
    statistic : ndarray of shape (n_components,)
        Eta squared for classes: the share of the variance of a coefficient that lies
        between the classes, from 0 to 1. Spearman's rank correlation for numbers, from
        -1 to 1.
    p_value : ndarray of shape (n_components,)
        Permutation p-values, corrected for the number of coefficients. Each is the
        share of permutations in which this coefficient, or any weaker one, has at least
        the observed statistic. NaN if they cannot be tested.
    n_frames : int
        Number of frames with coefficients; copies of a frame count once.
    permuted : str
        The units that were permuted: "groups", "frames", or, if neighbouring frames
        depend on each other, "frequencies" or "blocks of 40 frames"; with "within
        groups" if they were permuted within groups.
    untested : str
        Why there are no p-values; empty if there are.
    corrected : ndarray of shape (n_components,) or None
        The statistic corrected for attenuation: that of coefficients without errors, an
        estimate that can exceed one. None without `alpha_std`.
    """

    kind: str
    statistic: NDArray
    p_value: NDArray
    n_frames: int
    permuted: str
    untested: str = ""
    corrected: NDArray | None = None

    def __repr__(self) -> str:
        """Return the results as a table and what they are."""
        name, meaning = _frame_columns.STATISTICS[self.kind]
        values = {name: self.statistic}
        if self.corrected is not None:
            values["corrected"] = self.corrected
        columns = {"": [f"alpha_{k + 1}" for k in range(len(self.p_value))]}
        columns |= {name: [f"{v:.2f}" for v in each] for name, each in values.items()}
        columns["p"] = ["" if self.untested else f"{p:.3f}" for p in self.p_value]
        test = f"p-values: permutations of {self.permuted}"
        if self.untested:
            test = f"no p-values: {self.untested}"
        return f"{aligned(columns)}\n{name}: {meaning}; {test}; {self.n_frames} frames"

    def to_frame(self) -> "pd.DataFrame":
        """
        Return the results as a table.

        Returns
        -------
        DataFrame
            A row for each coefficient, counted from 1, with its statistic, the
            corrected one if it is known, and p_value.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        name = "eta_squared" if self.kind == "classes" else "spearman"
        index = pd.RangeIndex(1, len(self.statistic) + 1, name="component")
        columns = {name: self.statistic, f"{name}_corrected": self.corrected}
        columns = {key: each for key, each in columns.items() if each is not None}
        columns["p_value"] = self.p_value
        return pd.DataFrame(columns, index=index)


def association(
    alpha: Any,
    y: Any,
    groups: Any = None,
    *,
    time: Any = None,
    alpha_std: Any = None,
    kind: str = "auto",
    n_permutations: int = 999,
    random_state: Any = None,
) -> Association:
    """
    Test the association of each coefficient with a label of the frames.

    Parameters
    ----------
    alpha : array-like of shape (n_frames, n_components)
        Coefficients. Frames with NaN are left out.
    y : array-like of shape (n_frames,)
        A label for each frame: classes, such as expressions, or a number, such as an
        age.
    groups : array-like of shape (n_frames,), default=None
        People, videos or other groups with similar frames. Means of labels over
        groups are permuted among the groups, differences from them within each group.
    time : array-like of shape (n_frames,), default=None
        Times of the frames; None for the order of the rows. If neighbours in time
        depend on each other, frequencies or blocks are permuted instead of frames.
        Without groups, the runs between gaps of the times are groups.
    alpha_std : array-like of shape (n_frames, n_components), default=None
        Posterior standard deviations of the coefficients, `alpha_std_`. If given, the
        statistic is also corrected for attenuation by them.
    kind : {"auto", "classes", "number"}, default="auto"
        Kind of the labels. "auto" treats names, booleans and whole numbers as classes,
        as scikit-learn does.
    n_permutations : int, default=999
        Number of permutations. The least p-value is one over this number plus one.
    random_state : int, RandomState instance or None, default=None
        Seed of the permutations.

    Returns
    -------
    Association
        Named tuple of kind, statistic, p_value (n_components,), n_frames, permuted,
        untested and corrected.

    Raises
    ------
    ValueError
        If labels are missing, infinite, all equal, or classes that are all different.

    Notes
    -----
    The p-values are those of step-down maximum statistics (Westfall, Young,
    "Resampling-based multiple testing", 1993): without any association, the probability
    that any of them falls below a level is at most that level.

    If labels differ both between and within groups, both parts are tested together.
    Each part is divided by its mean over the permutations, and the parts are summed.

    p-values are for equal means, or no rank correlation: classes may differ in spread.
    The statistics of independent frames and of groups are studentised (Chung, Romano,
    "Exact and asymptotically robust permutation tests", 2013). With eight groups and
    more, what each adds within it gets random signs, if labels stay the same over
    neighbours or these depend on each other, as in sessions. If frames repeat people
    that are not given, nearest neighbours have one label: then there are no p-values.

    A correlation with a coefficient of errors is too small by the root of its
    reliability, eta squared by the reliability (Spearman, "The proof and measurement of
    association between two things", 1904): the variance of the coefficient over that
    variance plus the mean square of `alpha_std`.

    Neighbouring frames are compared after removal of the part of the coefficients that
    labels explain. Frames sorted by their label can thus be independent. If they are
    not, the frequencies of the coefficients (cosine transform) get random signs and
    sizes; if they are sorted, blocks are permuted. There are no p-values for less than
    eight blocks, or two frequencies that coefficients and labels share, in effect: a
    drift and a label that changes once, or regular rhythms. Neither are there any for
    joined clips, which are recognised by jumps, without `groups`.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.analysis import association
    >>> rng = np.random.default_rng(0)
    >>> alpha, smile = rng.normal(size=(200, 2)), np.repeat(["no", "yes"], 100)
    >>> alpha[smile == "yes", 1] += 2
    >>> found = association(alpha, smile, random_state=0)
    >>> found.p_value < 0.01
    array([False,  True])
    """
    check_scalar(n_permutations, "n_permutations", Integral, min_val=1)
    given = alpha
    alpha, labels, _, order = _known_frames(alpha, y, groups, time)
    kind = _frame_columns.kind_of(labels, kind)
    columns, classes = _label_columns(labels, kind), kind == "classes"
    standard = _unit_columns(alpha if classes else rankdata(alpha, axis=0))
    covariances = columns.T @ standard
    statistic = np.sum(covariances**2, axis=0) if classes else covariances[0]
    rng = check_random_state(random_state)
    energies, permuted, untested = _permutations.permuted_energies(
        alpha, standard, columns, order, n_permutations, rng
    )
    p_value = _step_down_p_values(energies)
    if untested:
        p_value[:] = np.nan
    found = Association(kind, statistic, p_value, len(alpha), permuted, untested)
    if alpha_std is None:
        return found
    ratio = _reliability(given, alpha_std)
    return found._replace(corrected=statistic / (ratio if classes else np.sqrt(ratio)))


def predictability(
    features: Any,
    y: Any,
    groups: Any = None,
    *,
    time: Any = None,
    kind: str = "auto",
    n_folds: int = 5,
    random_state: Any = None,
) -> NDArray:
    """
    Return the cross-validated prediction of a label from all features.

    Parameters
    ----------
    features : array-like of shape (n_frames, n_features)
        Coefficients, or other features to compare with. Frames with NaN are left out.
    y : array-like of shape (n_frames,)
        A label for each frame.
    groups : array-like of shape (n_frames,), default=None
        People, videos or other groups. Frames of a group are in one fold.
    time : array-like of shape (n_frames,), default=None
        See `association`. Without groups, blocks of dependent frames are in one fold.
    kind : {"auto", "classes", "number"}, default="auto"
        See `association`.
    n_folds : int, default=5
        Number of folds; fewer where a class has fewer frames, or if there are fewer
        groups.
    random_state : int, RandomState instance or None, default=None
        Seed of the folds.

    Returns
    -------
    ndarray of shape (n_folds,)
        For classes the accuracy of linear discriminant analysis of the standardised
        features. For numbers R^2 of ridge regression on them.

    Raises
    ------
    ValueError
        As in `association`, or if a class or the table is too small for two folds.
    """
    check_scalar(n_folds, "n_folds", Integral, min_val=2)
    features, labels, numbers, order = _known_frames(features, y, groups, time)
    kind = _frame_columns.kind_of(labels, kind)
    if groups is None:
        numbers = _dependent_frames(features, labels, kind, order, n_folds)
    most, model = len(labels), RidgeCV(np.logspace(-3, 3, 13))
    splitter = KFold if numbers is None else GroupKFold
    if kind == "classes":
        most = int(np.unique(labels, return_counts=True)[1].min())
        model = LinearDiscriminantAnalysis()
        splitter = StratifiedKFold if numbers is None else StratifiedGroupKFold
    if numbers is not None:
        most = min(most, len(np.unique(numbers)))
    if most < 2:
        raise ValueError(
            "two folds need two frames of each class, and two groups where there are "
            f"groups; got {most}"
        )
    folds = splitter(min(n_folds, most), shuffle=True, random_state=random_state)
    model = make_pipeline(StandardScaler(), model)
    return np.asarray(
        cross_val_score(model, features, labels, groups=numbers, cv=folds)
    )


def _known_frames(
    features: Any, y: Any, groups: Any, time: Any
) -> tuple[NDArray, NDArray, NDArray | None, _permutations.FrameOrder]:
    """Return features, labels, groups and order of different frames without NaN."""
    features = check_array(
        features, dtype=np.float64, ensure_all_finite="allow-nan", input_name="alpha"
    )
    finite = np.flatnonzero(np.isfinite(features).all(axis=1))
    if not len(finite):
        raise ValueError("no frame has coefficients: all rows of alpha have NaN")
    labels = _frame_columns.checked_column("y", y, len(features))
    _frame_columns.refuse_infinite("y", labels, np.arange(len(features)))
    seconds = _frame_columns.checked_times(time, len(features))
    if groups is None and time is not None:  # gaps are no jumps of a clip
        groups = _frame_columns.runs_between_gaps(seconds)
    numbers = _frame_columns.group_numbers(groups, len(features))
    classes = np.unique(labels, return_inverse=True)[1][finite]
    rows = np.column_stack([_rounded(features[finite]), classes])
    finite = finite[np.sort(np.unique(rows, axis=0, return_index=True)[1])]
    order = _permutations.FrameOrder(numbers[finite], seconds[finite])
    return features[finite], labels[finite], numbers[finite], order


def _reliability(alpha: Any, alpha_std: Any) -> NDArray:
    """Return the shares (K,) of the variance of coefficients that are no errors."""
    alpha, deviations = np.asarray(alpha, float), np.asarray(alpha_std, float)
    if deviations.shape != alpha.shape:
        raise ValueError(
            f"alpha_std must have the shape {alpha.shape} of alpha; got "
            f"{deviations.shape}"
        )
    variance = np.nanvar(alpha, axis=0)
    total = variance + np.nanmean(deviations**2, axis=0)
    return np.asarray(variance / np.where(total > 0, total, np.nan))


def _rounded(features: NDArray) -> NDArray:
    """Round features (n, k), so that copies of a frame are equal, and few others.

    Crops and conversions of an image move its points by rounding errors. To at most a
    thousandth of the standard deviations: about one of 100 other frames has an equal.
    """
    (n, k), size = features.shape, features.std(axis=0)
    precision = min(1e-3, 2.0 * (0.02 / n) ** (1.0 / k))
    return np.rint(features / (precision * np.where(size > 0, size, 1.0)))


def _step_down_p_values(energies: NDArray) -> NDArray:
    """Return p-values (K,) of energies (n, K), of which the first row is observed."""
    weakest_first = np.argsort(energies[0], kind="stable")
    energies = energies[:, weakest_first]
    largest = np.maximum.accumulate(energies, axis=1)
    # Tolerance for rounding: equal energies count as large.
    larger = (largest >= energies[0] * (1 - OF_DIFFERENCES)).mean(axis=0)
    p_value = np.empty(len(larger))
    p_value[weakest_first] = np.maximum.accumulate(larger[::-1])[::-1]
    return p_value


def _label_columns(labels: NDArray, kind: str) -> csr_array:
    """Return ranks, or indicators of classes, as columns (n_frames, n_columns).

    The sum of their squared covariances with a column of norm one is eta squared, or
    the square of Spearman's rank correlation.
    """
    if kind == "number":
        return csr_array(_unit_columns(rankdata(labels)[:, None]))
    columns = _permutations.indicators(np.unique(labels, return_inverse=True)[1])
    return csr_array(columns / np.sqrt(columns.sum(axis=0)))


def _unit_columns(values: NDArray) -> NDArray:
    """Return columns (n, k), centred and of norm one; zero where constant."""
    values = values - values.mean(axis=0)
    size = np.linalg.norm(values, axis=0)
    return np.asarray(values / np.where(size > 0, size, 1.0))


def _dependent_frames(
    features: NDArray,
    labels: NDArray,
    kind: str,
    order: _permutations.FrameOrder,
    n_folds: int,
) -> NDArray | None:
    """Return the block of each frame (n_frames,), None for independent frames."""
    columns = _label_columns(labels, kind)[order.rows]
    residuals = _permutations.unexplained(
        _unit_columns(features)[order.rows], columns, order
    )
    length = _permutations.independent_length(residuals)
    if length == 1:
        return None
    blocks = np.empty(len(labels), dtype=int)
    blocks[order.rows] = order.blocks(min(length, -(-len(labels) // n_folds)))
    return blocks
