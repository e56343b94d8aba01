"""Figures of a model: mean shape, drift along each basis shape, mode covariance."""

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._fitted_model import frames_of
from isa_nrsfm.plotting import _views
from isa_nrsfm.plotting._views import Edges, Origin, choose_lines, view_and_layout

# Arrows in the units of the points, with the same width in all axes.
ARROW_STYLE = {
    **{"angles": "xy", "scale_units": "xy", "scale": 1.0, "units": "inches"},
    **{"width": 0.008, "headwidth": 3.8, "headlength": 4.2, "headaxislength": 3.8},
    **{"minlength": 0.5, "color": "0.15", "zorder": 3},
}


class BasisShapeDisplay:
    """
    Mean shape and basis shapes from the front and from the side.

    For each basis shape, the mean shape is drawn between the shapes at both ends of the
    drift, with arrows along the drift. Shapes of more than 400 points are drawn as two
    clouds on either side of the mean, without arrows. All shapes have the same scale,
    except basis shapes with a very large drift. These are drawn smaller, and the title
    gives the factor. It is recommended to use `from_estimator` to create the display.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        The mean shape in viewing coordinates: x points right, y along the y axis of the
        image, and z is the depth.
    basis : ndarray of shape (n_components, n_points, 3)
        The basis shapes in the same frame, each as a drift by one standard deviation
        of its coefficient.
    energy_share : ndarray of shape (n_components,), default=None
        Share of each basis shape in the energy of the deformations, between 0 and 1,
        for the titles.
    component_names : list of str of length n_components, default=None
        Names of the basis shapes. By default their numbers, from 1.
    edges : "auto", Skeleton, str, None or array-like of shape (n_edges, 2), \
            default="auto"
        Lines to draw: a layout of `isa_nrsfm.skeletons` or its name, or pairs of
        points. A layout has separate colours for left and right in the mean shape.
        "auto" recognises a known layout by the number and order of the points. Up to
        400 points without one are joined by a minimal spanning tree, the tree with the
        shortest lines.
    origin : {"auto", "upper", "lower"}, default="auto"
        Where y is zero: "upper" for images, whose y points down, "lower" for a y that
        points up. "auto" is "lower" if a face or a body would otherwise be upside down.
    depth_note : str, default=""
        Certainty of the depth, shown below each side view. `from_estimator` sets it,
        for example to "depth not determined". All z are zero then, and there is no side
        view.

    Attributes
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        The mean shape.
    basis : ndarray of shape (n_components, n_points, 3)
        The basis shapes, in standard deviations of their coefficients.
    energy_share : ndarray of shape (n_components,) or None
        The share of each basis shape in the energy of the deformations.
    component_names : list of str
        The names of the basis shapes.
    skeleton : Skeleton or None
        The layout that is drawn; None for points alone.
    edges : ndarray of shape (n_edges, 2) or None
        The pairs of points that are joined.
    origin : {"upper", "lower"}
        Where y is zero.
    depth_note : str
        The certainty of the depth.
    components_ : ndarray of shape (n_drawn,)
        The basis shapes that are drawn.
    axes_ : ndarray of shape (1 + n_drawn, 2)
        The axes: the mean shape, then the basis shapes; front view, then side view.
    figure_ : matplotlib Figure
        The figure that holds them.
    mean_ : list of matplotlib PathCollection
        The points of the mean shape, one entry for each of the axes, in their order.
    plus_, minus_ : list of matplotlib PathCollection
        The points at the two ends of the drift, one entry for each of the axes of the
        basis shapes.
    arrows_ : list of matplotlib Quiver
        The arrows from the mean shape, for the same axes; empty for dense shapes.

    Raises
    ------
    ValueError
        If the shapes of the arrays do not fit together, `edges` names points that do
        not exist, or the number of names is not that of the basis shapes.

    See Also
    --------
    ModeCovarianceDisplay : The mode covariance matrix.
    ReprojectionDisplay : Observed against reprojected points.

    Notes
    -----
    An affine factorisation leaves a 3x3 affinity of space open. `from_estimator`
    chooses the one under which the cameras come nearest to scaled orthographic ones
    [1]_, so that shapes have natural proportions. The front view is that of the mean
    camera. Shapes of calibrated cameras are only rotated. If the cameras go round the
    object, they have no mean view. Their axis then keeps its direction in the images,
    and the front is the broadest side of the object. Faces, bodies and hands of known
    layouts are then turned upright (`isa_nrsfm.calibration.canonical_pose`). The sign
    of the depth is unknown: the side view may be from the left or from the right.

    References
    ----------
    .. [1] L. Quan, "Self-calibration of an affine camera from multiple views",
       International Journal of Computer Vision 19, 93-105, 1996.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.plotting import BasisShapeDisplay
    >>> rng = np.random.default_rng(0)
    >>> mean_shape = rng.standard_normal((20, 3))
    >>> basis = 0.1 * rng.standard_normal((2, 20, 3))
    >>> display = BasisShapeDisplay(mean_shape=mean_shape, basis=basis).plot()
    >>> display.axes_.shape
    (3, 2)
    """

    def __init__(
        self,
        *,
        mean_shape: ArrayLike,
        basis: ArrayLike,
        energy_share: ArrayLike | None = None,
        component_names: list[str] | None = None,
        edges: Edges = "auto",
        origin: Origin = "auto",
        depth_note: str = "",
    ) -> None:
        self.depth_note = depth_note
        self.mean_shape = np.asarray(mean_shape, dtype=float)
        self.basis = np.asarray(basis, dtype=float)
        shape = self.mean_shape.shape
        if len(shape) != 2 or shape[1] != 3 or self.basis.shape[1:] != shape:
            raise ValueError(
                "mean_shape must have shape (n_points, 3) and basis (n_components, "
                f"n_points, 3); got {shape} and {self.basis.shape}"
            )
        n_components = len(self.basis)
        share = None if energy_share is None else np.asarray(energy_share, dtype=float)
        if share is not None and share.shape != (n_components,):
            raise ValueError(
                f"energy_share must hold {n_components} numbers, one per basis shape; "
                f"got shape {share.shape}"
            )
        self.energy_share = share
        self.component_names = _views.names_of_shapes(component_names, n_components)
        _, self.skeleton, self.origin = choose_lines(edges, origin, self.mean_shape)
        self.edges = None if self.skeleton is None else self.skeleton.edges

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        *,
        component_names: list[str] | None = None,
        edges: Edges = "auto",
        origin: Origin = "auto",
        ax: Any = None,
        **kw: Any,
    ) -> Self:
        """
        Draw the mean shape and the basis shapes of a fitted estimator.

        Parameters
        ----------
        estimator : AffineNRSfM
            A fitted estimator.
        component_names : list of str of length n_components, default=None
            Names of the basis shapes. By default their numbers, from 1.
        edges : "auto", Skeleton, str, None or array-like of shape (n_edges, 2), \
                default="auto"
            Lines to draw: a layout of `isa_nrsfm.skeletons` or its name, or pairs of
            points. "auto" recognises a known layout by the names or by the number and
            order of the points. The tree of other points is that of their distances in
            the images. Faces, bodies and hands of known layouts stand upright for any
            value of `edges`.
        origin : {"auto", "upper", "lower"}, default="auto"
            Where y is zero: "upper" for images, whose y points down, "lower" for a y
            that points up. "auto" is "lower" if a face or a body would otherwise be
            upside down.
        ax : array-like of matplotlib Axes, default=None
            Axes to draw on, two per shape. By default a new figure.
        **kw : dict
            Further arguments of `plot`.

        Returns
        -------
        BasisShapeDisplay
            The display, drawn.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If the estimator is not fitted.
        ValueError
            If a parameter is not of the kind given above, or the number of names or of
            axes is not that of the shapes.
        """
        check_is_fitted(estimator, "mean_shape_")
        view, layout, skeleton, origin = view_and_layout(estimator, edges, origin)
        shape = estimator.mean_shape_ @ view.T
        view = _views.upright_turn(shape, layout, origin) @ view
        if not frames_of(estimator).certainty.determined:
            view[2] = 0.0
        deviation = np.nanstd(estimator.alpha_, axis=0)[:, None, None]
        display = cls(
            mean_shape=estimator.mean_shape_ @ view.T,
            basis=deviation * (estimator.basis_ @ view.T),
            energy_share=estimator.energy_share_,
            component_names=component_names,
            edges=skeleton,
            origin=origin,
            depth_note=_views.depth_note(estimator),
        )
        return display.plot(ax, **kw)

    def plot(
        self,
        ax: Any = None,
        *,
        n_std: float = 2.0,
        components: ArrayLike | None = None,
        n_columns: int | None = None,
        point_kw: dict[str, Any] | None = None,
    ) -> Self:
        """
        Draw the shapes.

        Parameters
        ----------
        ax : array-like of matplotlib Axes, default=None
            Axes to draw on, two per shape, the mean shape first. By default a new
            figure with a legend below.
        n_std : float, default=2.0
            Length of the drift to both sides, in standard deviations of the
            coefficients.
        components : array-like of int, default=None
            The basis shapes to draw. By default all of them.
        n_columns : int, default=None
            Shapes side by side in the new figure. By default as few as fit on a page.
        point_kw : dict, default=None
            Arguments for the scatters of points. They override the defaults.

        Returns
        -------
        BasisShapeDisplay
            The display itself.

        Raises
        ------
        ValueError
            If there are not two axes per shape, or if `components` names a basis shape
            that does not exist.
        """
        self.components_ = _views.chosen_numbers(
            components, "components", len(self.basis), "numbers of basis shapes"
        )
        n_drawn = len(self.components_)
        drift, mean = n_std * self.basis[self.components_], self.mean_shape
        blocks = [mean[None], *(np.stack([mean, mean - d, mean + d]) for d in drift)]
        limits, reduction = _views.block_limits(blocks)
        page = ax
        if ax is None:
            page = _views.new_page(1 + n_drawn, np.ptp(limits[0], axis=1), n_columns)
        axes = _views.flat_axes(page, 2 + 2 * n_drawn, "two views for each shape")
        self.axes_, self.figure_ = axes.reshape(-1, 2), axes[0].figure

        size = f"{n_std:g} standard deviations"
        labels = "mean shape", f"\N{MINUS SIGN}{size}", f"+{size}"
        colours = _views.MEAN_COLOUR, _views.MINUS_COLOUR, _views.PLUS_COLOUR
        looks = [{"color": c, "label": t} for c, t in zip(colours, labels, strict=True)]
        artists: list[list[Any]] = [[], [], [], []]
        self.mean_, self.minus_, self.plus_, self.arrows_ = artists
        for block, (pair, shapes) in enumerate(zip(self.axes_, blocks, strict=True)):
            for view, axis in zip(_views.VIEWS, pair, strict=True):
                _views.hide_frame(axis)
                _views.show_view(axis, view, limits[block], self.origin)
                if not mean[:, view[0]].any():  # no depth, no side view
                    continue
                for drawn, shape, look in zip(artists, shapes, looks, strict=False):
                    style = look | (point_kw or {})
                    drawn.append(self._draw(axis, shape[:, view], style, not block))
                if block and not _views.is_dense(mean):
                    ends = (*mean[:, view].T, *drift[block - 1][:, view].T)
                    self.arrows_.append(axis.quiver(*ends, **ARROW_STYLE))
            title = _views.wrap_title(self._title(block, reduction[block]), pair)
            pair[0].set_title(title, loc="left", fontsize="small")
            pair[1].set_xlabel(self.depth_note, loc="right", fontsize="x-small")
        if ax is None:
            entries = [drawn[-1] for drawn in artists[:3]]
            _views.add_legend(self.figure_, entries, self.skeleton, markerscale=3.0)
        return self

    def _draw(self, axis: Any, points: NDArray, style: Any, sided: bool) -> Any:
        """Draw one shape in one view, the mean shape with colours of the sides."""
        layout = self.skeleton
        if layout is not None:
            colours = colour = style["color"]
            if sided and colour == _views.MEAN_COLOUR:
                colours = _views.side_colours(layout.edge_sides, colour)
                style = style | {"color": _views.side_colours(layout.sides, colour)}
            _views.draw_segments(axis, points[layout.edges], colors=colours)
            style = {"s": 2.0} | style
        return _views.draw_points(axis, points, **style)

    def _title(self, block: int, reduction: float) -> str:
        """Return the title of the mean shape (0) or of a basis shape."""
        if block == 0:
            side = self.mean_shape[:, 2].any()
            return "Mean shape, front and side" if side else "Mean shape"
        k = self.components_[block - 1]
        name = self.component_names[k]
        title, notes = f"Basis shape {name}" if name == str(k + 1) else name, []
        if self.energy_share is not None:
            notes.append(f"{_views.percent(self.energy_share[k])} of energy")
        if reduction > 1:
            notes.append(f"drawn 1:{reduction:.2g}")
        return f"{title} ({', '.join(notes)})" if notes else title


BLOCK = 3  # directions of space, rows and columns of one basis shape's block
LINEAR_SHARE = 0.02  # of the largest absolute value, end of the linear colour scale


class ModeCovarianceDisplay:
    """
    Mode covariance matrix with the 3x3 blocks of the basis shapes.

    If the independent subspaces are correct, the energy is in the diagonal blocks. It
    is recommended to use `from_estimator` to create the display.

    Parameters
    ----------
    mode_covariance : ndarray of shape (3 * n_components, 3 * n_components)
        The symmetric covariance of the modes, with the three modes of a basis shape
        side by side.
    component_names : list of str of length n_components, default=None
        Names of the basis shapes. By default their numbers, from 1.

    Attributes
    ----------
    mode_covariance : ndarray of shape (3 * n_components, 3 * n_components)
        The matrix, as given.
    component_names : list of str
        The names of the basis shapes.
    off_block_share : float
        Share of the sum of squares of the matrix outside its diagonal blocks, between 0
        and 1.
    ax_ : matplotlib Axes
        The axes with the image.
    figure_ : matplotlib Figure
        The figure that holds them.
    im_ : matplotlib AxesImage
        The image.
    boundaries_ : matplotlib LineCollection
        The lines between the blocks, vertical ones first.
    colorbar_ : matplotlib Colorbar
        The colour bar.

    Raises
    ------
    ValueError
        If the matrix is not square with three rows per basis shape, or the number of
        names is not that of the basis shapes.

    See Also
    --------
    BasisShapeDisplay : The basis shapes.
    ReprojectionDisplay : Observed against reprojected points.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.plotting import ModeCovarianceDisplay
    >>> covariance = np.kron(np.diag([2.0, 1.0]), np.eye(3))
    >>> display = ModeCovarianceDisplay(mode_covariance=covariance)
    >>> display.off_block_share
    0.0
    >>> display.plot().figure_
    <Figure size ...>
    """

    def __init__(
        self, *, mode_covariance: ArrayLike, component_names: list[str] | None = None
    ) -> None:
        matrix = np.asarray(mode_covariance, dtype=float)
        n_modes = len(matrix) if matrix.ndim == 2 else 0
        if not n_modes or matrix.shape != (n_modes, n_modes) or n_modes % BLOCK:
            raise ValueError(
                "mode_covariance must be a square matrix with three rows per basis "
                f"shape; got shape {matrix.shape}"
            )
        self.mode_covariance = matrix
        self.component_names = _views.names_of_shapes(component_names, n_modes // BLOCK)

    @property
    def off_block_share(self) -> float:
        """Share of the sum of squares that lies outside the diagonal blocks."""
        squares = self.mode_covariance**2
        blocks = np.kron(np.eye(len(self.component_names)), np.ones((BLOCK, BLOCK)))
        total = squares.sum()
        return float((squares * (1 - blocks)).sum() / total) if total > 0 else 0.0

    @classmethod
    def from_estimator(
        cls, estimator: Any, *, component_names: list[str] | None = None, ax: Any = None
    ) -> Self:
        """
        Draw the mode covariance matrix of a fitted estimator.

        Parameters
        ----------
        estimator : AffineNRSfM
            A fitted estimator.
        component_names : list of str of length n_components, default=None
            Names of the basis shapes. By default their numbers, from 1.
        ax : matplotlib Axes, default=None
            Axes to draw on. By default a new figure.

        Returns
        -------
        ModeCovarianceDisplay
            The display, drawn.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If the estimator is not fitted.
        ValueError
            If the number of names is not that of the basis shapes, or `ax` is not a
            single Axes.
        """
        check_is_fitted(estimator, "mode_covariance_")
        matrix = estimator.mode_covariance_
        return cls(mode_covariance=matrix, component_names=component_names).plot(ax)

    def plot(self, ax: Any = None) -> Self:
        """
        Draw the matrix: blue is negative, red positive and white zero.

        The scale of the colours is linear up to 2 % of the largest absolute value, and
        logarithmic beyond: the energy of basis shapes falls quickly, and on a linear
        scale only the first ones may be visible.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            Axes to draw on. By default a new figure.

        Returns
        -------
        ModeCovarianceDisplay
            The display itself.

        Raises
        ------
        ValueError
            If `ax` holds several axes.
        """
        colors = import_optional("matplotlib.colors", extra="plot")
        ticker = import_optional("matplotlib.ticker", extra="plot")
        options: dict[str, Any] = {"figsize": (4.4, 3.6), "layout": "compressed"}
        (self.ax_,) = _views.flat_axes(ax, 1, "the matrix", **options)
        self.figure_ = self.ax_.figure
        values = self.mode_covariance
        largest = np.abs(values).max() or 1.0
        norm = colors.AsinhNorm(LINEAR_SHARE * largest, vmin=-largest, vmax=largest)
        style = {"cmap": "RdBu_r", "norm": norm, "interpolation": "nearest"}
        self.im_ = self.ax_.imshow(values, **style)

        n_modes, names = len(values), self.component_names
        # Of 16 labels of two digits some touch in the default figure.
        step = -(-len(names) // 12)
        cuts = np.arange(BLOCK, n_modes, BLOCK) - 0.5
        upright = np.array([[(x, y) for y in (-0.5, n_modes - 0.5)] for x in cuts])
        lines = np.concatenate([upright, upright[..., ::-1]])
        style = {"colors": "0.35", "linewidths": 0.6 / step, "capstyle": "butt"}
        self.boundaries_ = _views.draw_segments(self.ax_, lines, **style)
        centres = np.arange(0, len(names), step) * BLOCK + (BLOCK - 1) / 2
        for axis in (self.ax_.xaxis, self.ax_.yaxis):
            axis.set_ticks(centres, labels=names[::step])
            axis.set_label_text("basis shape")
        title = f"{_views.percent(self.off_block_share)} outside the diagonal blocks"
        self.ax_.set_title(f"{title}\n(0 % if uncorrelated)", fontsize="small")
        self.ax_.tick_params(length=0)
        if max(map(len, names)) > 3:
            self.ax_.tick_params("x", rotation=90)
        # In the linear part, numbers beside zero would overlap.
        linear = 10 * LINEAR_SHARE * largest
        ticks = ticker.SymmetricalLogLocator(base=10, linthresh=linear)
        self.colorbar_ = self.figure_.colorbar(
            self.im_, ax=self.ax_, label="covariance", ticks=ticks
        )
        self.colorbar_.minorticks_off()
        return self
