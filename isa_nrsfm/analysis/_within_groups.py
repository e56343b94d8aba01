"""Coefficients relative to a person, and their variance between persons.

Frames aligned in the image, for comparison with coefficients.
"""

from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, OneToOneFeatureMixin, TransformerMixin
from sklearn.utils import check_array
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import fit_context
from isa_nrsfm._tables import CHECKS
from isa_nrsfm.analysis._association import between_shares, indicators
from isa_nrsfm.analysis._frame_columns import checked_column, group_names, group_numbers


class WithinGroups(OneToOneFeatureMixin, TransformerMixin, BaseEstimator):
    """
    Coefficients of frames relative to the mean of their group.

    Subtracting the mean of a person removes the appearance of the person and leaves the
    changes: expressions, gestures, poses. With `neutral`, frames are compared with the
    neutral frames of their group.

    Groups are metadata: in a `Pipeline` they are routed to this step after
    ``sklearn.set_config(enable_metadata_routing=True)`` and
    ``WithinGroups().set_fit_request(groups=True).set_transform_request(groups=True)``.

    Attributes
    ----------
    groups_ : ndarray of shape (n_groups,)
        Names or numbers of the groups of the fit, sorted.
    means_ : ndarray of shape (n_groups, n_features)
        Means that are subtracted from their frames.
    n_features_in_ : int
        Number of features.

    Examples
    --------
    >>> from isa_nrsfm.analysis import WithinGroups
    >>> alpha = [[1.0, 0.0], [3.0, 0.0], [0.0, 5.0], [0.0, 7.0]]
    >>> WithinGroups().fit_transform(alpha, groups=["Ann", "Ann", "Bob", "Bob"])
    array([[-1.,  0.],
           [ 1.,  0.],
           [ 0., -1.],
           [ 0.,  1.]])
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {}

    @fit_context(nested=False)
    def fit(
        self, X: Any, y: Any = None, *, groups: Any = None, neutral: Any = None
    ) -> Self:
        """
        Learn the means of groups.

        Parameters
        ----------
        X : array-like of shape (n_frames, n_features)
            Coefficients; NaN where a frame has none.
        y : None
            Ignored.
        groups : array-like of shape (n_frames,), default=None
            Group of each frame; None for one group.
        neutral : array-like of bool, shape (n_frames,), default=None
            Neutral frames, which define the means; None for all.

        Returns
        -------
        WithinGroups
            The transformer.

        Raises
        ------
        ValueError
            If groups are missing, or if a group has no neutral frame.
        """
        X = validate_data(self, X, **CHECKS)
        self.groups_, self.means_ = _group_means(X, groups, neutral)
        return self

    def transform(self, X: Any, groups: Any = None, neutral: Any = None) -> NDArray:
        """
        Return coefficients minus the mean of their group.

        Parameters
        ----------
        X : array-like of shape (n_frames, n_features)
            Coefficients; NaN where a frame has none.
        groups : array-like of shape (n_frames,), default=None
            Group of each frame; None for one group. Groups of the fit keep their fitted
            mean. For new groups, the mean of their frames in X is used.
        neutral : array-like of bool, shape (n_frames,), default=None
            Neutral frames, which define the means of new groups; None for all.

        Returns
        -------
        ndarray of shape (n_frames, n_features)
            The differences.

        Raises
        ------
        ValueError
            If groups are missing, or if a new group has no neutral frame.

        Warns
        -----
        UserWarning
            If a new group has one frame only, whose differences are zero.
        """
        check_is_fitted(self)
        X = validate_data(self, X, reset=False, **CHECKS)
        names = group_names(groups, len(X))
        place = np.searchsorted(self.groups_, names).clip(max=len(self.groups_) - 1)
        matched = self.groups_[place] == names
        means = np.asarray(self.means_[place], dtype=X.dtype)
        if not matched.all():
            new = names[~matched]
            flags = None if neutral is None else np.asarray(neutral)[~matched]
            others, of_others = _group_means(X[~matched], new, flags)
            means[~matched] = of_others[np.searchsorted(others, new)]
            if neutral is None:
                _warn_of_single_frames(new)
        return np.asarray(X - means)

    def fit_transform(
        self, X: Any, y: Any = None, *, groups: Any = None, neutral: Any = None
    ) -> NDArray:
        """
        Learn the means of groups, and return coefficients minus them.

        Parameters
        ----------
        X : array-like of shape (n_frames, n_features)
            Coefficients; NaN where a frame has none.
        y : None
            Ignored.
        groups : array-like of shape (n_frames,), default=None
            Group of each frame; None for one group.
        neutral : array-like of bool, shape (n_frames,), default=None
            Neutral frames, which define the means; None for all.

        Returns
        -------
        ndarray of shape (n_frames, n_features)
            The differences.

        Raises
        ------
        ValueError
            See `fit`.

        Warns
        -----
        UserWarning
            If a group has one frame only, whose differences are zero.
        """
        fitted = self.fit(X, y, groups=groups, neutral=neutral)
        if neutral is None and groups is not None:
            _warn_of_single_frames(np.asarray(groups))
        return fitted.transform(X, groups)

    def __sklearn_tags__(self) -> Any:
        """Return the tags of scikit-learn: NaN is allowed."""
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags


def _group_means(X: NDArray, groups: Any, neutral: Any) -> tuple[NDArray, NDArray]:
    """Return the groups, sorted, and the means (n_groups, n_features) of each."""
    names = group_names(groups, len(X))
    used = np.isfinite(X).all(axis=1)
    if neutral is not None:
        used &= checked_column("neutral", neutral, len(X)).astype(bool)
    found, numbers = np.unique(names, return_inverse=True)
    sizes = np.bincount(numbers[used], minlength=len(found))
    if not sizes.all():
        what, remedy = "frame with coefficients", ""
        if neutral is not None:
            what, remedy = "neutral frame", ", or mark one of their frames as neutral"
        raise ValueError(
            f"groups without a {what}: {np.sum(sizes == 0)} of {len(found)} (first: "
            f"{', '.join(map(str, found[sizes == 0][:5]))}). Their coefficients have "
            f"nothing to be compared with. Remove these groups{remedy}"
        )
    return found, indicators(numbers[used]).T @ X[used] / sizes[:, None]


def _warn_of_single_frames(names: NDArray) -> None:
    """Warn of groups with one frame."""
    single = np.unique(names, return_counts=True)[1] == 1
    if single.any():
        warn_caller(
            f"groups with a single frame: {single.sum()} of {len(single)}. Their "
            "differences from the group are zero. Remove these groups, or mark neutral "
            "frames"
        )


class BetweenShare(NamedTuple):
    """
    Share of the variance of each coefficient between groups.

    Attributes
    ----------
    between : ndarray of shape (n_components,)
        Variance between groups divided by the whole variance, from 0 to 1.
    within : ndarray of shape (n_components,)
        Variance within groups divided by the whole variance.
    n_groups : int
        Number of groups.
    n_frames : int
        Number of frames with coefficients.
    """

    between: NDArray
    within: NDArray
    n_groups: int
    n_frames: int


def between_share(alpha: Any, groups: Any) -> BetweenShare:
    """
    Return the share of the variance of each coefficient between groups.

    With people as groups, coefficients of identity vary mainly between groups, and
    coefficients of expression mainly within groups.

    Parameters
    ----------
    alpha : array-like of shape (n_frames, n_components)
        Coefficients. Frames with NaN are left out.
    groups : array-like of shape (n_frames,)
        Group of each frame.

    Returns
    -------
    BetweenShare
        Named tuple of between, within (n_components,), n_groups and n_frames.

    Raises
    ------
    ValueError
        If groups are missing, if there is one group only, or if no group has two
        frames.

    Notes
    -----
    The share is the intraclass correlation ICC(1). The variance components of one-way
    random effects are estimated from the mean squares between and within groups
    (Searle, Casella, McCulloch, "Variance components", 1992, section 3.6). Random
    groups have a share of about zero, regardless of the number of frames. Negative
    estimates are set to zero.
    """
    X = check_array(alpha, input_name="alpha", **CHECKS | {"dtype": np.float64})
    finite = np.isfinite(X).all(axis=1)
    numbers = np.unique(group_numbers(groups, len(X))[finite], return_inverse=True)[1]
    X = X[finite]
    sizes = np.bincount(numbers)
    n_frames, n_groups = len(X), len(sizes)
    if n_groups < 2 or n_frames == n_groups:
        raise ValueError(
            "variances between and within groups need two groups, and one with two "
            f"frames; got {n_groups} groups of {n_frames} frames"
        )
    means = indicators(numbers).T @ X / sizes[:, None]
    within = np.sum((X - means[numbers]) ** 2, axis=0)
    share = between_shares(within, sizes @ (means - X.mean(axis=0)) ** 2, sizes)
    return BetweenShare(share, 1.0 - share, n_groups, n_frames)


class AlignedFrames(OneToOneFeatureMixin, TransformerMixin, BaseEstimator):
    """
    Align frames with their mean by translation, scale and rotation in the image.

    Generalised Procrustes analysis in the plane (Gower, "Generalized Procrustes
    analysis", 1975). PCA of aligned frames is a baseline for coefficients. It uses the
    same table, but mixes the view with the deformation.

    Attributes
    ----------
    mean_ : ndarray of shape (n_points,)
        The mean of the aligned frames of the fit, complex numbers x + iy of mean zero
        and mean square one.
    n_features_in_ : int
        Number of columns.
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {}

    @fit_context(nested=False)
    def fit(self, X: Any, y: Any = None) -> Self:
        """
        Find the mean of the frames.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A complete table, columns x and y of each point in turn.
        y : None
            Ignored.

        Returns
        -------
        AlignedFrames
            The transformer.
        """
        points = _unit_points(validate_data(self, X, dtype=np.float64))
        self.mean_ = points[0]
        for _ in range(100):
            before, mean = self.mean_, _nearest_turns(points, self.mean_).mean(axis=0)
            self.mean_ = mean / np.sqrt(np.mean(np.abs(mean) ** 2))
            if np.abs(self.mean_ - before).max() < 1e-10:  # of its size
                break
        return self

    def transform(self, X: Any) -> NDArray:
        """
        Return the aligned frames.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A complete table, columns x and y of each point in turn.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            Frames of mean zero and mean square one.
        """
        check_is_fitted(self)
        points = _unit_points(validate_data(self, X, dtype=np.float64, reset=False))
        return np.ascontiguousarray(_nearest_turns(points, self.mean_)).view(float)


def _unit_points(X: NDArray) -> NDArray:
    """Return frames (n, 2J) as complex numbers (n, J) of mean zero, mean square one."""
    if X.shape[1] % 2:
        raise ValueError(f"X must have two columns per point; got {X.shape[1]} columns")
    points = np.ascontiguousarray(X, dtype=float).view(complex)
    points = points - points.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(np.abs(points) ** 2, axis=1, keepdims=True))
    return points / np.where(size > 0, size, 1.0)


def _nearest_turns(points: NDArray, mean: NDArray) -> NDArray:
    """Return frames (n, J) turned to be nearest to a mean (J,)."""
    angles = np.angle(points @ mean.conj())
    return np.asarray(points * np.exp(-1j * angles)[:, None])
