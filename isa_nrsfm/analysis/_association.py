"""How coefficients go with a label: a class or a number for each frame."""

from collections.abc import Callable
from numbers import Integral
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
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

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._tables.frame_columns import checked_column, group_numbers
from isa_nrsfm.analysis._labels import kind_of

if TYPE_CHECKING:
    import pandas as pd

# Weights of the ridge regression of numbers on standardised coefficients.
RIDGES = np.logspace(-3, 3, 13)


class Association(NamedTuple):
    """
    How each coefficient goes with a label.

    Attributes
    ----------
    kind : {"classes", "number"}
        What the labels are.
    statistic : ndarray of shape (n_components,)
        Eta squared for classes: the share of the variance of a coefficient that lies
        between the classes, from 0 to 1. Spearman's rank correlation for numbers, from
        -1 to 1.
    p_value : ndarray of shape (n_components,)
        Permutation p-values, corrected for the number of coefficients: the share of
        permutations of the labels in which any coefficient has a statistic as large.
    n_frames : int
        Number of frames with coefficients.
    """

    kind: str
    statistic: NDArray
    p_value: NDArray
    n_frames: int

    def to_frame(self) -> "pd.DataFrame":
        """
        Return the results as a table.

        Returns
        -------
        DataFrame
            A row for each coefficient, counted from 1, with its statistic and p_value.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        pd = import_optional("pandas", extra="io")
        name = "eta_squared" if self.kind == "classes" else "spearman"
        index = pd.RangeIndex(1, len(self.statistic) + 1, name="component")
        return pd.DataFrame(
            {name: self.statistic, "p_value": self.p_value}, index=index
        )


def association(
    alpha: Any,
    y: Any,
    groups: Any = None,
    *,
    kind: str = "auto",
    n_permutations: int = 999,
    random_state: Any = None,
) -> Association:
    """
    Return how each coefficient goes with a label of the frames.

    Parameters
    ----------
    alpha : array-like of shape (n_frames, n_components)
        Coefficients. Frames with NaN are left out.
    y : array-like of shape (n_frames,)
        A label for each frame: classes, such as expressions, or a number, such as an
        age.
    groups : array-like of shape (n_frames,), default=None
        People, videos or other groups whose frames are alike. Labels that differ within
        groups are permuted within them only. Labels that are the same for all frames of
        a group are permuted among the groups.
    kind : {"auto", "classes", "number"}, default="auto"
        What the labels are. "auto" takes names, truth values and whole numbers for
        classes, as scikit-learn does.
    n_permutations : int, default=999
        Number of permutations. The least p-value is one over this number plus one.
    random_state : int, RandomState instance or None, default=None
        Of the permutations.

    Returns
    -------
    Association
        Named tuple of kind, statistic, p_value (n_components,) and n_frames.

    Raises
    ------
    ValueError
        If labels are missing, all equal, or classes that are all different.

    Notes
    -----
    The p-values are those of the largest statistic of all coefficients (Westfall,
    Young, "Resampling-based multiple testing", 1993): the chance that any of them falls
    below a level by chance is at most that level.

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
    alpha, known = _known_frames(alpha)
    labels = checked_column("y", y, len(known))[known]
    numbers = group_numbers(groups, len(known))
    numbers = None if numbers is None else numbers[known]
    found = kind_of(labels, kind)
    rng = check_random_state(random_state)
    statistics: Callable[[NDArray, NDArray], NDArray]
    if found == "classes":
        values, statistics = np.unique(labels, return_inverse=True)[1], _eta_squared
    else:
        values, statistics = _unit_ranks(labels[:, None])[:, 0], _correlations
        alpha = _unit_ranks(alpha)
    statistic = statistics(alpha, values)
    larger = np.zeros(len(statistic))
    for _ in range(n_permutations):
        shuffled = statistics(alpha, _permuted(values, numbers, rng))
        # Rounding: a permutation that changes nothing counts as large.
        larger += np.abs(shuffled).max() >= np.abs(statistic) * (1 - 1e-12)
    p_value = (1.0 + larger) / (1.0 + n_permutations)
    return Association(found, statistic, p_value, len(alpha))


def predictability(
    features: Any,
    y: Any,
    groups: Any = None,
    *,
    kind: str = "auto",
    n_folds: int = 5,
    random_state: Any = None,
) -> NDArray:
    """
    Return how well features together tell a label, cross-validated.

    Parameters
    ----------
    features : array-like of shape (n_frames, n_features)
        Coefficients, or other features to compare with. Frames with NaN are left out.
    y : array-like of shape (n_frames,)
        A label for each frame.
    groups : array-like of shape (n_frames,), default=None
        People, videos or other groups. Frames of a group are in one fold.
    kind : {"auto", "classes", "number"}, default="auto"
        As of `association`.
    n_folds : int, default=5
        Number of folds; fewer where a class has fewer frames, or if there are fewer
        groups.
    random_state : int, RandomState instance or None, default=None
        Of the folds.

    Returns
    -------
    ndarray of shape (n_folds,)
        For classes the accuracy of linear discriminant analysis of the standardised
        features. For numbers R^2 of ridge regression on them.

    Raises
    ------
    ValueError
        As of `association`, or if a class or the table is too small for two folds.
    """
    check_scalar(n_folds, "n_folds", Integral, min_val=2)
    features, known = _known_frames(features)
    labels = checked_column("y", y, len(known))[known]
    numbers = group_numbers(groups, len(known))
    numbers = None if numbers is None else numbers[known]
    found = kind_of(labels, kind)
    most = len(labels)
    if found == "classes":
        most = int(np.unique(labels, return_counts=True)[1].min())
    if numbers is not None:
        most = min(most, len(np.unique(numbers)))
    if most < 2:
        raise ValueError(
            "two folds need two frames of each class, and two groups where there are "
            f"groups; got {most}"
        )
    n_folds = min(n_folds, most)
    splitter = {
        ("classes", True): StratifiedKFold,
        ("classes", False): StratifiedGroupKFold,
        ("number", True): KFold,
        ("number", False): GroupKFold,
    }[found, numbers is None]
    model = LinearDiscriminantAnalysis() if found == "classes" else RidgeCV(RIDGES)
    return np.asarray(
        cross_val_score(
            make_pipeline(StandardScaler(), model),
            features,
            labels,
            groups=numbers,
            cv=splitter(n_folds, shuffle=True, random_state=random_state),
        )
    )


def _known_frames(features: Any) -> tuple[NDArray, NDArray]:
    """Return features of the frames without NaN, and which those are (n_frames,)."""
    features = check_array(
        features, dtype=np.float64, ensure_all_finite="allow-nan", input_name="alpha"
    )
    known = np.isfinite(features).all(axis=1)
    if not known.any():
        raise ValueError("no frame has coefficients: all rows of alpha have NaN")
    return features[known], known


def _eta_squared(alpha: NDArray, classes: NDArray) -> NDArray:
    """Return the share of the variance of each coefficient between classes (n,)."""
    centred = alpha - alpha.mean(axis=0)
    sizes = np.bincount(classes)
    sums = np.stack([np.bincount(classes, column) for column in centred.T], axis=1)
    between = np.sum(sums**2 / sizes[:, None], axis=0)
    total = np.sum(centred**2, axis=0)
    return np.divide(between, total, where=total > 0, out=np.zeros_like(total))


def _unit_ranks(values: NDArray) -> NDArray:
    """Return ranks of columns (n, k), centred and of norm one."""
    ranks = rankdata(values, axis=0)
    ranks = ranks - ranks.mean(axis=0)
    size = np.linalg.norm(ranks, axis=0)
    return ranks / np.where(size > 0, size, 1.0)


def _correlations(alpha: NDArray, values: NDArray) -> NDArray:
    """Return the correlations of columns (n, K) with values (n,), both of norm one."""
    return values @ alpha


def _permuted(
    values: NDArray, groups: NDArray | None, rng: np.random.RandomState
) -> NDArray:
    """Return labels (n,) permuted within groups (n,), or among them."""
    if groups is None:
        return np.asarray(rng.permutation(values))
    first = np.unique(groups, return_index=True)[1]
    if (values == values[first][groups]).all():
        return np.asarray(rng.permutation(values[first])[groups])
    # Rows in the order of their groups, once as they are and once shuffled inside
    order = np.argsort(groups, kind="stable")
    shuffled = np.lexsort((rng.random_sample(len(groups)), groups))
    permuted = np.empty_like(values)
    permuted[order] = values[shuffled]
    return permuted
