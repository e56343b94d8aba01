"""Scores by the number of basis shapes, with the chosen one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.plotting._axes import MINUS_COLOUR, PLUS_COLOUR, flat_axes


class ComponentChoiceDisplay:
    """
    Cross-validation scores against the number of basis shapes.

    It is recommended to use `from_estimator` to create the display.

    Parameters
    ----------
    n_components : array-like of int, shape (n_candidates,)
        The numbers of basis shapes that were tried.
    scores : array-like of shape (n_candidates, n_splits)
        The score of each on the frames that were held out.
    chosen : int, default=None
        The number that was chosen, which is marked.
    held_out_error : bool, default=True
        Whether `AffineNRSfM.score` computed the scores, which are then minus the
        held-out errors. If True, the errors are drawn in percent.

    Attributes
    ----------
    n_components : ndarray of int, shape (n_candidates,)
        The numbers, as given.
    scores : ndarray of shape (n_candidates, n_splits)
        The scores, as given.
    chosen : int or None
        The number that was chosen.
    held_out_error : bool
        Whether errors are drawn.
    ax_ : matplotlib Axes
        The axes with the curve.
    figure_ : matplotlib Figure
        The figure that holds them.
    errorbar_ : matplotlib ErrorbarContainer
        The curve of the means, with bars of one standard error over the splits.
    chosen_ : matplotlib Line2D or None
        The mark of the chosen number.

    Raises
    ------
    ValueError
        If there is not one row of scores for each number, or the chosen one is not
        among them.

    See Also
    --------
    isa_nrsfm.AffineNRSfMCV : Chooses the number of basis shapes.

    Examples
    --------
    >>> from isa_nrsfm.plotting import ComponentChoiceDisplay
    >>> display = ComponentChoiceDisplay(
    ...     n_components=[1, 2, 3],
    ...     scores=[[-0.02, -0.03], [-0.006, -0.005], [-0.007, -0.006]],
    ...     chosen=2,
    ... )
    >>> display.plot().figure_
    <Figure size ...>
    """

    def __init__(
        self,
        *,
        n_components: ArrayLike,
        scores: ArrayLike,
        chosen: int | None = None,
        held_out_error: bool = True,
    ) -> None:
        self.n_components = np.asarray(n_components)
        self.scores = np.asarray(scores, dtype=float)
        rows = self.scores.shape[:1] if self.scores.ndim == 2 else None
        if self.n_components.ndim != 1 or rows != self.n_components.shape:
            raise ValueError(
                "scores must have one row for each of n_components and one column for "
                f"each split; got shapes {self.scores.shape} and "
                f"{self.n_components.shape}"
            )
        if chosen is not None and chosen not in self.n_components:
            raise ValueError(
                f"chosen must be one of n_components, {self.n_components.tolist()}; "
                f"got {chosen}"
            )
        self.chosen, self.held_out_error = chosen, held_out_error

    @classmethod
    def from_estimator(
        cls, estimator: Any, *, ax: Any = None, **kw: Any
    ) -> ComponentChoiceDisplay:
        """
        Draw the scores of a fitted `AffineNRSfMCV`.

        Parameters
        ----------
        estimator : AffineNRSfMCV
            A fitted estimator.
        ax : matplotlib Axes, default=None
            Axes to draw on. By default a new figure.
        **kw : dict
            Further arguments of `plot`.

        Returns
        -------
        ComponentChoiceDisplay
            The display, drawn.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If the estimator is not fitted.
        ValueError
            If `ax` is not a single Axes.
        """
        check_is_fitted(estimator)
        results = estimator.cv_results_
        splits = range(estimator.n_splits_)
        display = cls(
            n_components=results["param_n_components"],
            scores=np.transpose([results[f"split{i}_test_score"] for i in splits]),
            chosen=estimator.n_components_,
            held_out_error=estimator.scoring is None,
        )
        return display.plot(ax, **kw)

    def plot(self, ax: Any = None) -> ComponentChoiceDisplay:
        """
        Draw the curve.

        Parameters
        ----------
        ax : matplotlib Axes, default=None
            Axes to draw on. By default a new figure.

        Returns
        -------
        ComponentChoiceDisplay
            The display itself.

        Raises
        ------
        ValueError
            If `ax` holds several axes.
        """
        import_optional("matplotlib", extra="plot")
        (self.ax_,) = flat_axes(ax, 1, "the curve", figsize=(5.2, 3.2))
        self.figure_ = self.ax_.figure
        values = -100 * self.scores if self.held_out_error else self.scores
        n_splits = values.shape[1]
        mean = values.mean(axis=1)
        bars = values.std(axis=1, ddof=1) / np.sqrt(n_splits) if n_splits > 1 else None
        style = {"fmt": "o-", "markersize": 4, "capsize": 3, "color": MINUS_COLOUR}
        style["label"] = "mean" if bars is None else "mean, one standard error"
        self.errorbar_ = self.ax_.errorbar(self.n_components, mean, bars, **style)
        self.chosen_ = None
        if self.chosen is not None:
            point = self.chosen, mean[np.argmax(self.n_components == self.chosen)]
            style = {"markerfacecolor": "none", "markeredgecolor": PLUS_COLOUR}
            style |= {"markersize": 10, "label": f"chosen: {self.chosen}"}
            (self.chosen_,) = self.ax_.plot(*point, "o", **style)
        label = "held-out error, %" if self.held_out_error else "score"
        self.ax_.set(xlabel="number of basis shapes", ylabel=label)
        self.ax_.xaxis.get_major_locator().set_params(integer=True)
        if self.held_out_error and mean.min() > 0 and mean.max() > 5 * mean.min():
            self.ax_.set_yscale("log")
        self.ax_.legend(frameon=False, fontsize="small")
        return self
