"""Observed and reprojected points of some frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._compat.scikit_learn import taken_rows
from isa_nrsfm._tables import FEWEST_POINTS, table_to_tracks, tracks_to_table, unmasked
from isa_nrsfm.metrics import inverse_snr
from isa_nrsfm.plotting import _axes
from isa_nrsfm.plotting._views import Edges, Origin, choose_lines, view_and_layout
from isa_nrsfm.skeletons._column_names import checked_names

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
        first = self.reprojected[0]
        _, self.skeleton, self.origin = choose_lines(edges, origin, first)
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
    ) -> ReprojectionDisplay:
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
        rows = _axes.chosen_numbers(frames, "frames", len(X), "row numbers of X")
        table = taken_rows(X, rows)
        _, _, skeleton, origin = view_and_layout(estimator, edges, origin)
        observed, reprojected = (
            table_to_tracks(np.asarray(each, dtype=float), estimator.layout)
            for each in (unmasked(table), estimator.reproject(table))
        )
        labelled = hasattr(X, "iloc")  # pandas: rows have names
        display = cls(
            observed=observed,
            reprojected=reprojected,
            frames=rows,
            frame_names=[str(name) for name in X.index[rows]] if labelled else None,
            edges=skeleton,
            origin=origin,
        )
        return display.plot(ax, **kw)

    def plot(
        self, ax: Any = None, *, n_columns: int | None = None
    ) -> ReprojectionDisplay:
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
        import_optional("matplotlib", extra="plot")
        n_frames = len(self.frames)
        n_columns = min(3, n_frames) if n_columns is None else n_columns
        height = (PANEL_WIDTH + 0.4) * -(-n_frames // n_columns)
        size = (PANEL_WIDTH * n_columns, height + _axes.LEGEND_HEIGHT)
        self.axes_ = _axes.flat_axes(
            ax, n_frames, "one for each frame", n_columns, figsize=size
        )
        self.figure_ = self.axes_[0].figure
        self.observed_: list[Any] = []
        self.reprojected_: list[Any] = []
        self.errors_: list[Any] = []
        self.edges_: list[Any] = []
        for i, axes in enumerate(self.axes_):
            self._plot_frame(axes, i)
        if ax is None:
            entries = [self.observed_[0], self.reprojected_[0]]
            scale = 4.0 if _axes.is_dense(self.observed[0]) else 1.0
            _axes.add_legend(self.figure_, entries, self.skeleton, markerscale=scale)
        return self

    def _plot_frame(self, axes: Any, i: int) -> None:
        """Draw one frame."""
        observed, reprojected = self.observed[i], self.reprojected[i]
        if self.skeleton is not None:
            colours = _axes.side_colours(self.skeleton.edge_sides, _axes.PLUS_COLOUR)
            style = {"colors": colours, "alpha": 0.8}
            segments = reprojected[self.skeleton.edges]
            self.edges_.append(_axes.draw_segments(axes, segments, **style))
        colour, thin = _axes.OBSERVED_COLOUR, {"linewidths": 0.6}
        style = {"color": colour}
        if not _axes.is_dense(observed):
            style = {"s": 14.0, "facecolors": "none", "edgecolors": colour} | thin
            error = np.stack([observed, reprojected], axis=1)
            self.errors_.append(_axes.draw_segments(axes, error, colors=colour, **thin))
        drawn = _axes.draw_points(axes, observed, label="observed", **style)
        self.observed_.append(drawn)
        style = {"color": _axes.PLUS_COLOUR, "label": "reprojected", "zorder": 2.5}
        self.reprojected_.append(_axes.draw_points(axes, reprojected, **style))
        _axes.hide_frame(axes)
        axes.set_aspect("equal", adjustable="datalim")
        axes.yaxis.set_inverted(self.origin == "upper")
        share = f"inverse SNR {_axes.percent(self.inverse_snr[i])}"
        axes.set_title(f"row {self.frame_names[i]}\n{share}", fontsize="small")
