"""The mode covariance matrix as an image with its blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm.plotting._axes import flat_axes, percent
from isa_nrsfm.skeletons._column_names import checked_names

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
        self.component_names = checked_names(
            "component_names", component_names, range(1, n_modes // BLOCK + 1)
        )

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
    ) -> ModeCovarianceDisplay:
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
        display = cls(
            mode_covariance=estimator.mode_covariance_, component_names=component_names
        )
        return display.plot(ax)

    def plot(self, ax: Any = None) -> ModeCovarianceDisplay:
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
        import_optional("matplotlib", extra="plot")
        from matplotlib.collections import LineCollection
        from matplotlib.colors import AsinhNorm
        from matplotlib.ticker import SymmetricalLogLocator

        options: dict[str, Any] = {"figsize": (4.4, 3.6), "layout": "compressed"}
        (self.ax_,) = flat_axes(ax, 1, "the matrix", **options)
        self.figure_ = self.ax_.figure

        values = self.mode_covariance
        largest = np.abs(values).max() or 1.0
        norm = AsinhNorm(LINEAR_SHARE * largest, vmin=-largest, vmax=largest)
        style = {"cmap": "RdBu_r", "norm": norm, "interpolation": "nearest"}
        self.im_ = self.ax_.imshow(values, **style)

        n_modes, names = len(values), self.component_names
        # Of 16 labels of two digits some touch in the default figure.
        step = -(-len(names) // 12)
        cuts = np.arange(BLOCK, n_modes, BLOCK) - 0.5
        ends = [-0.5, n_modes - 0.5]
        lines = [[(cut, end) for end in ends] for cut in cuts]
        lines += [[(end, cut) for end in ends] for cut in cuts]
        boundaries = LineCollection(lines, colors="0.35", linewidths=0.6 / step)
        self.boundaries_ = self.ax_.add_collection(boundaries)
        centres = np.arange(0, len(names), step) * BLOCK + (BLOCK - 1) / 2
        for axis in (self.ax_.xaxis, self.ax_.yaxis):
            axis.set_ticks(centres, labels=names[::step])
            axis.set_label_text("basis shape")
        title = f"{percent(self.off_block_share)} outside the diagonal blocks"
        self.ax_.set_title(f"{title}\n(0 % if uncorrelated)", fontsize="small")
        self.ax_.tick_params(length=0)
        if max(map(len, names)) > 3:
            self.ax_.tick_params("x", rotation=90)
        # In the linear part, numbers beside zero would overlap.
        ticks = SymmetricalLogLocator(base=10, linthresh=10 * LINEAR_SHARE * largest)
        bar = self.figure_.colorbar(
            self.im_, ax=self.ax_, label="covariance", ticks=ticks
        )
        bar.minorticks_off()
        self.colorbar_ = bar
        return self
