"""Figures of frames: their coefficients, and their observed and reprojected points."""

from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.scikit_learn import taken_rows
from isa_nrsfm._tables import FEWEST_POINTS, table_to_tracks, tracks_to_table, unmasked
from isa_nrsfm.analysis._frame_columns import checked_column, checked_std, kind_of
from isa_nrsfm.metrics import inverse_snr
from isa_nrsfm.plotting import _views
from isa_nrsfm.plotting._views import Edges, Origin, choose_lines, view_and_layout
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
        self.alpha_std = (
            None if alpha_std is None else checked_std(alpha_std, self.alpha)
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
        self.component_names = _views.names_of_shapes(component_names, n_components)

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
    ) -> Self:
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
        given: dict[str, Any] = {"y": y, "time": time, "groups": groups, "label": label}
        given["component_names"] = component_names
        return cls(alpha=alpha, alpha_std=deviation, **given).plot(ax, **kw)

    def plot(self, ax: Any = None, *, kind: Literal["auto"] | Kind = "auto") -> Self:
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
        found: Kind = "time"
        if self.y is not None and kind != "time":
            found = kind_of(self.y, kind)
        elif kind not in ("auto", "time"):
            raise ValueError(f"kind={kind!r} needs y, a label for each frame")
        n_components = self.alpha.shape[1]
        size = (_views.PAGE_WIDTH, 1.3 * n_components + 0.5)  # inches
        self.axes_ = _views.flat_axes(
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
        classes, members = _rows_of_largest(np.asarray(self.y))
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
            medianprops={"color": _views.OBSERVED_COLOUR, "linewidth": 1.4},
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
        axes.plot(times, curve, color=_views.MINUS_COLOUR, linewidth=0.9)
        single = [piece[0] for piece in pieces if len(piece) == 1]
        if single:
            axes.plot(time[single], alpha[single, k], ".", color=_views.MINUS_COLOUR)
        if self.alpha_std is not None:
            # It is narrower than the curve in tables with little noise.
            median = np.nanmedian(self.alpha_std[rows, k])
            title = f"band: one standard deviation, {median:.2g} (median)"
            axes.set_title(title, loc="right", fontsize="x-small")
            deviation = np.insert(self.alpha_std[rows, k], gaps, np.nan)
            style = {"color": _views.MINUS_COLOUR, "alpha": 0.25, "linewidth": 0}
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
    style = {"color": _views.MINUS_COLOUR, "alpha": 0.5, "linewidths": 0}
    axes.scatter(x, y, s=5, rasterized=True, **style)


PANEL_WIDTH = 2.3  # inches


class ReprojectionDisplay:
    """
    Observed against reprojected points, one panel per frame.

    It is recommended to use `from_estimator` to create the display.

    Parameters
    ----------
    observed : ndarray of shape (n_frames, n_points, 2)
        The points of the frames, NaN where a point was not seen.
    reprojected : ndarray of shape (n_frames, n_points, 2)
        The same points, reprojected by the model.
    frames : ndarray of shape (n_frames,), default=None
        Their row numbers. By default 0, 1, ...
    frame_names : list of str of length n_frames, default=None
        Names of the frames, for the titles. By default their row numbers.
    edges : "auto", Skeleton, str, None or array-like of shape (n_edges, 2), \
            default=None
        Lines to draw: a layout of `isa_nrsfm.skeletons` or its name, or pairs of
        points. A layout has separate colours for left and right. "auto" recognises a
        known layout by the number and order of the points in the first frame. Up to
        400 points without one are joined by a minimal spanning tree.
    origin : {"auto", "upper", "lower"}, default="upper"
        Where y is zero: "upper" for images, whose y points down, "lower" for a y that
        points up. "auto" is "lower" if a face or a body would otherwise be upside down
        in the first frame.

    Attributes
    ----------
    observed : ndarray of shape (n_frames, n_points, 2)
        The points of the frames.
    reprojected : ndarray of shape (n_frames, n_points, 2)
        The same points, reprojected by the model.
    frames : ndarray of shape (n_frames,)
        The row numbers.
    frame_names : list of str
        The names of the frames.
    inverse_snr : ndarray of shape (n_frames,)
        For each frame, the squared error of its observed points divided by their
        squared distance from their centroid.
    skeleton : Skeleton or None
        The layout that is drawn; None for points alone.
    edges : ndarray of shape (n_edges, 2) or None
        The pairs of points that are joined.
    origin : {"upper", "lower"}
        Where y is zero.
    axes_ : ndarray of shape (n_frames,)
        The axes, one per frame.
    figure_ : matplotlib Figure
        The figure that holds them.
    observed_ : list of matplotlib PathCollection
        The observed points, one entry per frame.
    reprojected_ : list of matplotlib PathCollection
        The reprojected points, one entry per frame.
    errors_ : list of matplotlib LineCollection
        The segments from observed to reprojected points, one entry per frame. Empty for
        dense shapes of more than 400 points.
    edges_ : list of matplotlib LineCollection
        The lines between reprojected points, one entry per frame; empty without edges.

    Raises
    ------
    ValueError
        If the shapes of the arrays do not fit together, `edges` names points that do
        not exist, or no point of a frame was seen.

    See Also
    --------
    BasisShapeDisplay : The basis shapes.
    ModeCovarianceDisplay : The mode covariance matrix.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.plotting import ReprojectionDisplay
    >>> observed = np.array([[[0.0, 0.0], [4.0, 0.0], [2.0, 3.0]]])
    >>> display = ReprojectionDisplay(observed=observed, reprojected=1.1 * observed)
    >>> display.inverse_snr.round(6)
    array([0.01])
    >>> display.plot().figure_
    <Figure size ...>
    """

    def __init__(
        self,
        *,
        observed: ArrayLike,
        reprojected: ArrayLike,
        frames: ArrayLike | None = None,
        frame_names: list[str] | None = None,
        edges: Edges = None,
        origin: Origin = "upper",
    ) -> None:
        self.observed = np.asarray(observed, dtype=float)
        self.reprojected = np.asarray(reprojected, dtype=float)
        shape = self.observed.shape
        if len(shape) != 3 or shape[2] != 2 or self.reprojected.shape != shape:
            raise ValueError(
                "observed and reprojected must both have shape (n_frames, n_points, "
                f"2); got {shape} and {self.reprojected.shape}"
            )
        self.frames = np.arange(shape[0]) if frames is None else np.asarray(frames)
        if self.frames.shape != shape[:1]:
            raise ValueError(
                f"frames must name the {shape[0]} frames; got shape {self.frames.shape}"
            )
        self.frame_names = checked_names("frame_names", frame_names, self.frames)
        _, self.skeleton, self.origin = choose_lines(edges, origin, self.reprojected[0])
        self.edges = None if self.skeleton is None else self.skeleton.edges
        tables = map(tracks_to_table, (self.observed, self.reprojected))
        rows = zip(*tables, strict=True)
        self.inverse_snr = np.array([inverse_snr([x], [fitted]) for x, fitted in rows])

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        X: Any,
        *,
        n_frames: int | None = None,
        frames: ArrayLike | None = None,
        random_state: Any = None,
        edges: Edges = "auto",
        origin: Origin = "auto",
        ax: Any = None,
        **kw: Any,
    ) -> Self:
        """
        Draw some frames of a table and their reprojection by a fitted estimator.

        Parameters
        ----------
        estimator : AffineNRSfM
            A fitted estimator.
        X : array-like of shape (n_rows, 2 * n_points)
            A table of landmarks in the estimator's layout. The titles name the rows
            of a pandas DataFrame by its index.
        n_frames : int, default=None
            How many rows to draw at random, without repetition, of the rows with at
            least four points. By default 6, or all of fewer rows.
        frames : array-like of int, default=None
            The rows to draw, in place of random ones.
        random_state : int, RandomState instance or None, default=None
            Determines the random rows. Pass an int for the same rows at each call.
        edges : "auto", Skeleton, str, None or array-like of shape (n_edges, 2), \
                default="auto"
            Lines to draw: a layout of `isa_nrsfm.skeletons` or its name, or pairs of
            points. "auto" recognises a known layout by the names of the points, or by
            the number and order of those of the mean shape. Up to 400 points without a
            known one are joined by the minimal spanning tree of `BasisShapeDisplay`.
        origin : {"auto", "upper", "lower"}, default="auto"
            Where y is zero: "upper" for images, whose y points down, "lower" for a y
            that points up. "auto" is "lower" if a face or a body would otherwise be
            upside down.
        ax : array-like of matplotlib Axes, default=None
            Axes to draw on, one per frame. By default a new figure.
        **kw : dict
            Further arguments of `plot`.

        Returns
        -------
        ReprojectionDisplay
            The display, drawn.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If the estimator is not fitted.
        ValueError
            If `X` lacks the rows of `frames` or has fewer than `n_frames`, if no point
            of a row was seen, if there are not as many axes as frames, or if `edges` or
            `origin` is not of the kind given above.
        """
        check_is_fitted(estimator, "mean_shape_")
        if frames is None:
            coordinates = np.isfinite(np.asarray(unmasked(X), dtype=float))
            rows = np.flatnonzero(coordinates.sum(axis=1) >= 2 * FEWEST_POINTS)
            n_frames = min(6, len(rows)) if n_frames is None else n_frames
            if not 1 <= n_frames <= len(rows):
                raise ValueError(
                    f"n_frames must be between 1 and the {len(rows)} rows of X with at "
                    f"least {FEWEST_POINTS} points; got {n_frames}"
                )
            rng = check_random_state(random_state)
            frames = np.sort(rng.choice(rows, size=n_frames, replace=False))
        rows = _views.chosen_numbers(frames, "frames", len(X), "row numbers of X")
        table = taken_rows(X, rows)
        _, _, skeleton, origin = view_and_layout(estimator, edges, origin)
        observed, reprojected = (
            table_to_tracks(np.asarray(each, dtype=float), estimator.layout)
            for each in (unmasked(table), estimator.reproject(table))
        )
        given: dict[str, Any] = {"frames": rows, "edges": skeleton, "origin": origin}
        given["frame_names"] = X.index[rows] if hasattr(X, "iloc") else None
        return cls(observed=observed, reprojected=reprojected, **given).plot(ax, **kw)

    def plot(self, ax: Any = None, *, n_columns: int | None = None) -> Self:
        """
        Draw the frames.

        Parameters
        ----------
        ax : array-like of matplotlib Axes, default=None
            Axes to draw on, one per frame. By default a new figure with a legend below.
        n_columns : int, default=None
            Columns of panels of the new figure. By default 3 or fewer.

        Returns
        -------
        ReprojectionDisplay
            The display itself.

        Raises
        ------
        ValueError
            If there are not as many axes as frames.
        """
        n_frames = len(self.frames)
        n_columns = min(3, n_frames) if n_columns is None else n_columns
        height = (PANEL_WIDTH + 0.4) * -(-n_frames // n_columns)
        size = (PANEL_WIDTH * n_columns, height + _views.LEGEND_HEIGHT)
        self.axes_ = _views.flat_axes(
            ax, n_frames, "one for each frame", n_columns, figsize=size
        )
        self.figure_ = self.axes_[0].figure
        panels = (self._plot_frame(axes, i) for i, axes in enumerate(self.axes_))
        artists = ([*filter(None, each)] for each in zip(*panels, strict=True))
        self.observed_, self.reprojected_, self.errors_, self.edges_ = artists
        if ax is None:
            entries = [self.observed_[0], self.reprojected_[0]]
            scale = 4.0 if _views.is_dense(self.observed[0]) else 1.0
            _views.add_legend(self.figure_, entries, self.skeleton, markerscale=scale)
        return self

    def _plot_frame(self, axes: Any, i: int) -> tuple[Any, ...]:
        """Draw one frame; return both kinds of points, and errors and edges if any."""
        observed, reprojected = self.observed[i], self.reprojected[i]
        errors = edges = None
        if self.skeleton is not None:
            colours = _views.side_colours(self.skeleton.edge_sides, _views.PLUS_COLOUR)
            segments = reprojected[self.skeleton.edges]
            edges = _views.draw_segments(axes, segments, colors=colours, alpha=0.8)
        colour, thin = _views.OBSERVED_COLOUR, {"linewidths": 0.6}
        style: dict[str, Any] = {"color": colour}
        if not _views.is_dense(observed):
            style = {"s": 14.0, "facecolors": "none", "edgecolors": colour} | thin
            segments = np.stack([observed, reprojected], axis=1)
            errors = _views.draw_segments(axes, segments, colors=colour, **thin)
        shown = _views.draw_points(axes, observed, label="observed", **style)
        style = {"color": _views.PLUS_COLOUR, "label": "reprojected", "zorder": 2.5}
        fitted = _views.draw_points(axes, reprojected, **style)
        _views.hide_frame(axes)
        axes.set_aspect("equal", adjustable="datalim")
        axes.yaxis.set_inverted(self.origin == "upper")
        share = f"inverse SNR {_views.percent(self.inverse_snr[i])}"
        axes.set_title(f"row {self.frame_names[i]}\n{share}", fontsize="small")
        return shown, fitted, errors, edges
