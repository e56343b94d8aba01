"""Coefficients by class, against a number, or in time."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm.analysis._frame_columns import checked_column, kind_of
from isa_nrsfm.plotting import _axes
from isa_nrsfm.skeletons._column_names import checked_names

Kind = Literal["classes", "number", "time"]
THIN = {"linewidth": 0.7}
# Largest number of groups or classes that are drawn. More of them overlap, and a figure
# of eight basis shapes and 1,000 classes takes 47 s.
MOST_GROUPS = 50


class CoefficientsDisplay:
    """
    Coefficients of frames: by class, against a number, or in time.

    There is one panel for each basis shape. Classes are drawn as box plots over their
    frames. Curves in time have a band of one standard deviation if it is known. It is
    recommended to use `from_estimator` to create the display.

    Parameters
    ----------
    alpha : array-like of shape (n_frames, n_components)
        Coefficients; NaN where a frame has none.
    alpha_std : array-like of shape (n_frames, n_components), default=None
        Their standard deviations.
    y : array-like of shape (n_frames,), default=None
        A label for each frame: classes, or a number. If there are more than 50 classes,
        those with the most frames are drawn, and the title mentions it.
    time : array-like of shape (n_frames,), default=None
        Times of the frames. By default their numbers.
    groups : array-like of shape (n_frames,), default=None
        Videos or people. Curves are not joined between groups. If there are more than
        50 groups, those with the most frames are drawn in time, and the title mentions
        it.
    label : str, default=None
        Name of `y` on the axis. By default that of a pandas Series, or "label".
    component_names : list of str of length n_components, default=None
        Names of the basis shapes. By default those of the columns of a dataframe
        `alpha`, or their numbers, from 1.

    Attributes
    ----------
    alpha, alpha_std, y, time, groups, label, component_names
        As given, as arrays.
    axes_ : ndarray of matplotlib Axes, shape (n_components,)
        The axes that were drawn on.
    figure_ : matplotlib Figure
        The figure that holds them.

    Raises
    ------
    ValueError
        If an array has not one row, or one entry, for each frame.

    See Also
    --------
    BasisShapeDisplay : The mean shape and the basis shapes.
    isa_nrsfm.analysis.association : Test of association with a label.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.plotting import CoefficientsDisplay
    >>> alpha = np.random.default_rng(0).normal(size=(20, 2))
    >>> display = CoefficientsDisplay(alpha=alpha, y=["no", "yes"] * 10)
    >>> display.plot().figure_
    <Figure size ...>
    """

    def __init__(
        self,
        *,
        alpha: Any,
        alpha_std: ArrayLike | None = None,
        y: Any = None,
        time: ArrayLike | None = None,
        groups: ArrayLike | None = None,
        label: str | None = None,
        component_names: list[str] | None = None,
    ) -> None:
        self.alpha = np.asarray(alpha, dtype=float)
        if self.alpha.ndim != 2:
            raise ValueError(
                "alpha must have a row for each frame and a column for each basis "
                f"shape; got shape {self.alpha.shape}"
            )
        self.alpha_std = None if alpha_std is None else np.asarray(alpha_std, float)
        if self.alpha_std is not None and self.alpha_std.shape != self.alpha.shape:
            raise ValueError(
                f"alpha_std must have the shape {self.alpha.shape} of alpha; "
                f"got {self.alpha_std.shape}"
            )
        n_frames, n_components = self.alpha.shape
        self.y, self.time, self.groups = (
            None if values is None else checked_column(name, values, n_frames)
            for name, values in (("y", y), ("time", time), ("groups", groups))
        )
        if label is None and getattr(y, "name", None) is not None:
            label = _no_mathematics(y.name)
        self.label = "label" if label is None else label
        if component_names is None and hasattr(alpha, "columns"):
            component_names = [*map(_no_mathematics, alpha.columns)]
        self.component_names = checked_names(
            "component_names", component_names, range(1, n_components + 1)
        )

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        X: Any = None,
        *,
        y: ArrayLike | None = None,
        time: ArrayLike | None = None,
        groups: ArrayLike | None = None,
        label: str | None = None,
        component_names: list[str] | None = None,
        ax: Any = None,
        **kw: Any,
    ) -> CoefficientsDisplay:
        """
        Draw the coefficients of a fitted estimator.

        Parameters
        ----------
        estimator : AffineNRSfM
            A fitted estimator.
        X : array-like of shape (n_frames, 2 * n_points), default=None
            A table with the points of the fitted one. By default the fitted table.
        y : array-like of shape (n_frames,), default=None
            A label for each frame: classes, or a number.
        time : array-like of shape (n_frames,), default=None
            Times of the frames. By default their numbers.
        groups : array-like of shape (n_frames,), default=None
            Videos or people. Curves are not joined between groups. If there are more
            than 50 groups, those with the most frames are drawn.
        label : str, default=None
            Name of `y` on the axis. By default that of a pandas Series, or "label".
        component_names : list of str of length n_components, default=None
            Names of the basis shapes. By default their numbers, from 1.
        ax : array of n_components matplotlib Axes, default=None
            Axes to draw on. By default a new figure.
        **kw : dict
            Further arguments of `plot`.

        Returns
        -------
        CoefficientsDisplay
            The display, drawn.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If the estimator is not fitted.
        ValueError
            If `CoefficientsDisplay` or `plot` refuses an argument.
        """
        check_is_fitted(estimator, "alpha_" if X is None else None)
        if X is None:
            alpha, deviation = estimator.alpha_, getattr(estimator, "alpha_std_", None)
        else:
            _, _, alpha, deviation = estimator.decompose(X)
        display = cls(
            alpha=alpha,
            alpha_std=deviation,
            y=y,
            time=time,
            groups=groups,
            label=label,
            component_names=component_names,
        )
        return display.plot(ax, **kw)

    def plot(
        self, ax: Any = None, *, kind: Literal["auto"] | Kind = "auto"
    ) -> CoefficientsDisplay:
        """
        Draw the coefficients.

        Parameters
        ----------
        ax : array of n_components matplotlib Axes, default=None
            Axes to draw on. By default a new figure.
        kind : {"auto", "classes", "number", "time"}, default="auto"
            Box plots for each class of `y`, points against the numbers of `y`, or
            curves in time. "auto" is the kind of `y`, or "time" if `y` is not given.

        Returns
        -------
        CoefficientsDisplay
            The display itself.

        Raises
        ------
        ValueError
            If `ax` has not one axes for each basis shape, or if `kind` needs `y`.
        """
        import_optional("matplotlib", extra="plot")
        found: Kind = "time"
        if self.y is not None and kind != "time":
            found = kind_of(self.y, kind)
        elif kind not in ("auto", "time"):
            raise ValueError(f"kind={kind!r} needs y, a label for each frame")
        n_components = self.alpha.shape[1]
        size = (_axes.PAGE_WIDTH, 1.3 * n_components + 0.5)  # inches
        self.axes_ = _axes.flat_axes(
            ax, n_components, "one for each basis shape", sharex=True, figsize=size
        )
        self.figure_ = self.axes_[0].figure
        for k, axes in enumerate(self.axes_):
            getattr(self, f"_draw_{found}")(axes, k)
            axes.set_ylabel(self.component_names[k])
            axes.axhline(0, color="0.85", linewidth=0.6, zorder=0)
            axes.spines[["top", "right"]].set_visible(False)
        label, divided = self.label, self.y if found == "classes" else None
        if found == "time":
            label, divided = "frame" if self.time is None else "time", self.groups
        self.axes_[-1].set_xlabel(label)
        n_groups = 0 if divided is None else len(np.unique(divided))
        if n_groups > MOST_GROUPS:
            parts = "groups" if found == "time" else "classes"
            title = f"the {MOST_GROUPS} of {n_groups} {parts} with the most frames"
            self.axes_[0].set_title(title, loc="left", fontsize="medium")
        return self

    def _draw_classes(self, axes: Any, k: int) -> None:
        """Draw box plots and the frames of each class, scattered sideways."""
        assert self.y is not None
        classes, members = _rows_of_largest(self.y)
        finite_rows = [rows[np.isfinite(self.alpha[rows, k])] for rows in members]
        rng = np.random.default_rng(0)  # horizontal positions have no meaning
        x = np.repeat(np.arange(0.0, len(classes)), [len(rows) for rows in finite_rows])
        x += 0.18 * rng.uniform(-1, 1, len(x))
        _scatter(axes, x, self.alpha[np.concatenate(finite_rows), k])
        axes.boxplot(
            [self.alpha[rows, k] for rows in finite_rows],
            positions=range(len(classes)),
            widths=0.6,
            showfliers=False,
            medianprops={"color": _axes.OBSERVED_COLOUR, "linewidth": 1.4},
            **dict.fromkeys(("boxprops", "whiskerprops", "capprops"), THIN),
        )
        names = [str(each) for each in classes]
        slope = 30 * (max(map(len, names)) * len(names) > 60)
        axes.set_xticks(range(len(names)), names, rotation=slope, parse_math=False)

    def _draw_number(self, axes: Any, k: int) -> None:
        """Draw the frames as points against their number."""
        _scatter(axes, np.asarray(self.y), self.alpha[:, k])

    def _draw_time(self, axes: Any, k: int) -> None:
        """Draw a curve, broken at gaps and groups, with a band of one deviation."""
        time: NDArray = np.arange(len(self.alpha)) if self.time is None else self.time
        pieces = self._pieces(time)
        rows = np.concatenate(pieces)
        # One line with gaps: a line for each piece takes minutes for thousands.
        gaps = np.cumsum([len(piece) for piece in pieces])[:-1]
        times, alpha = np.insert(time[rows], gaps, time[rows][gaps - 1]), self.alpha
        curve = np.insert(alpha[rows, k], gaps, np.nan)
        axes.plot(times, curve, color=_axes.MINUS_COLOUR, linewidth=0.9)
        single = [piece[0] for piece in pieces if len(piece) == 1]
        if single:
            axes.plot(time[single], alpha[single, k], ".", color=_axes.MINUS_COLOUR)
        if self.alpha_std is not None:
            # It is narrower than the curve in tables with little noise.
            median = np.nanmedian(self.alpha_std[rows, k])
            title = f"band: one standard deviation, {median:.2g} (median)"
            axes.set_title(title, loc="right", fontsize="x-small")
            deviation = np.insert(self.alpha_std[rows, k], gaps, np.nan)
            style = {"color": _axes.MINUS_COLOUR, "alpha": 0.25, "linewidth": 0}
            axes.fill_between(times, curve - deviation, curve + deviation, **style)

    def _pieces(self, time: NDArray) -> list[NDArray]:
        """Return the rows of each curve, in the order of the table."""
        groups = np.zeros(len(time), int) if self.groups is None else self.groups
        pieces = []
        for rows in _rows_of_largest(groups)[1]:
            apart = np.diff(time[rows])
            typical = np.median(apart) if len(apart) else apart.sum()
            # Curves stop at gaps of three times the median.
            cuts = np.flatnonzero((apart > 3 * typical) | (apart < 0 * typical))
            pieces += np.split(rows, cuts + 1)
        return pieces


def _no_mathematics(name: Any) -> str:
    """Return a name of a table as matplotlib draws it."""
    return str(name).replace("$", r"\$")


def _rows_of_largest(groups: NDArray) -> tuple[NDArray, list[NDArray]]:
    """Return the groups with the most frames, sorted, and the rows of each."""
    names, numbers, counts = np.unique(groups, return_inverse=True, return_counts=True)
    rows = np.split(np.argsort(numbers, kind="stable"), np.cumsum(counts)[:-1])
    largest = np.sort(np.argsort(-counts, kind="stable")[:MOST_GROUPS])
    return names[largest], [rows[group] for group in largest]


def _scatter(axes: Any, x: NDArray, y: NDArray) -> None:
    """Draw frames as faint points."""
    style = {"color": _axes.MINUS_COLOUR, "alpha": 0.5, "linewidths": 0}
    axes.scatter(x, y, s=5, rasterized=True, **style)
