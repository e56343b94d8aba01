"""The figures of a fit."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from isa_nrsfm import plotting
from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import whole_file
from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm.cli._columns import class_means, has_classes
from isa_nrsfm.cli._main import show_stage
from isa_nrsfm.cli._reading import Frames
from isa_nrsfm.cli._report import MOST_CLASSES, Fit
from isa_nrsfm.plotting import _views
from isa_nrsfm.skeletons._column_names import names_of_components

# Basis shapes and coefficients that are drawn, those with most energy: as many as
# `--n-components auto` finds with the joint fit. The panels of 40 shapes are too small.
MOST_DRAWN = 12


# By name: the caption, and the function that draws the figure.
Figures = dict[str, tuple[str, Callable[[Fit], Any]]]

# The figures of every fit.
ALWAYS: Figures = {
    "basis_shapes.png": (
        f"mean shape and basis shapes; of more than {MOST_DRAWN} those of most energy",
        lambda fit: plotting.BasisShapeDisplay.from_estimator(
            fit.estimator,
            components=np.arange(len(fit.estimator.basis_))[:MOST_DRAWN],
            **fit.drawn,
        ),
    ),
    "mode_covariance.png": (
        "whether basis shapes occur together; covariance of the deformations in the "
        "images, 3x3 blocks: zero off the diagonal if coefficients are uncorrelated",
        lambda fit: plotting.ModeCovarianceDisplay.from_estimator(fit.estimator),
    ),
    "reprojection.png": (
        "observed points and points of the model, in some of the frames",
        lambda fit: plotting.ReprojectionDisplay.from_estimator(
            fit.estimator, fit.frames.X, random_state=0, **fit.drawn
        ),
    ),
}


def figures_of(frames: Frames) -> Figures:
    """Return the figures of a fit, answers to the options first."""
    figures: Figures = {}
    for number, label in enumerate(frames.labels, 1):
        caption = f"coefficients by {label.name}"
        figures[f"label_{number}.png"] = caption, partial(_by_label, label)
        if has_classes(label, MOST_CLASSES):
            caption = f"mean shape of each {label.name}, and of all frames in grey"
            draw = partial(_shapes_by_label, label)
            figures[f"label_{number}_shapes.png"] = caption, draw
    if frames.times is not None:
        caption = "coefficients in time, with a band of one standard deviation"
        figures["time.png"] = caption, _in_time
    return figures | ALWAYS


def write_figures(folder: Path, figures: Figures, fit: Fit) -> dict[str, str]:
    """Draw figures without a screen; return the captions of those that were drawn."""
    import_optional("matplotlib", extra="plot").use("Agg")
    plt = import_optional("matplotlib.pyplot", extra="plot")
    drawn = {}
    for name, (caption, draw) in figures.items():
        show_stage(name)
        try:
            figure = draw(fit).figure_
            with whole_file(folder / name) as file:
                figure.savefig(file, format="png", dpi=150)
            plt.close(figure)
            drawn[name] = caption
        except OSError:
            raise
        except Exception as error:  # results do not depend on it
            warn_caller(f"{name} was not drawn: {error or type(error).__name__}")
    return drawn


def _by_label(label: "pd.Series", fit: Fit) -> plotting.CoefficientsDisplay:
    """Draw the coefficients by a label."""
    alpha = fit.estimator.alpha_[label.notna(), :MOST_DRAWN]
    names = names_of_components(None, alpha.shape[1])
    options = {"y": label.dropna(), "component_names": names}
    display = plotting.CoefficientsDisplay(alpha=alpha, **options)
    return display.plot(kind="classes" if has_classes(label) else "number")


def _in_time(fit: Fit) -> plotting.CoefficientsDisplay:
    """Draw the coefficients in time, smoothed ones if there are any."""
    frames, alpha = fit.frames, fit.estimator.alpha_
    deviation = getattr(fit.estimator, "alpha_std_", None)
    if fit.smooth is not None:
        alpha, deviation = fit.smooth[:2]
    options: dict[str, Any] = {"time": frames.times, "groups": frames.groups}
    options["component_names"] = names_of_components(None, alpha.shape[1])[:MOST_DRAWN]
    if deviation is not None:
        options["alpha_std"] = deviation[:, :MOST_DRAWN]
    display = plotting.CoefficientsDisplay(alpha=alpha[:, :MOST_DRAWN], **options)
    display.plot(kind="time")
    if frames.time_unit == "seconds" and np.asarray(frames.times).dtype.kind != "M":
        display.axes_[-1].set_xlabel("time, seconds")
    return display


def _shapes_by_label(label: "pd.Series", fit: Fit) -> plotting.BasisShapeDisplay:
    """Draw the mean shape of each class over that of all frames."""
    whole = plotting.BasisShapeDisplay.from_estimator(fit.estimator, **fit.drawn)
    import_optional("matplotlib.pyplot", extra="plot").close(whole.figure_)
    mean = whole.mean_shape
    means = [*class_means(label, fit.estimator.alpha_).values()]
    shapes = mean + np.tensordot(means, whole.basis, 1)
    (limits,), _ = _views.block_limits([np.concatenate([mean[None], shapes])])
    axes = _views.new_page(len(shapes), np.ptp(limits, axis=1), None).reshape(-1, 2)
    counts = label.value_counts(sort=False)
    same: dict[str, Any] = {"edges": whole.skeleton, "origin": whole.origin}
    same["basis"] = np.empty((0, *mean.shape))
    for shape, pair, (name, count) in zip(shapes, axes, counts.items(), strict=True):
        for points, colour in ((mean, "0.8"), (shape, _views.MEAN_COLOUR)):
            display = plotting.BasisShapeDisplay(mean_shape=points, **same)
            display.plot(pair, point_kw={"color": colour})
        for axis, view in zip(pair, _views.VIEWS, strict=True):
            _views.show_view(axis, view, limits, whole.origin)
        pair[1].set_xlabel(whole.depth_note, loc="right", fontsize="x-small")
        title = _views.wrap_title(f"{name} ({count} frames)", pair)
        pair[0].set_title(title, loc="left", fontsize="small", parse_math=False)
    line = import_optional("matplotlib.lines", extra="plot").Line2D
    style = {"marker": "o", "markersize": 3, "linewidth": 1.5}
    entries = [
        line([], [], color=colour, label=f"mean of {frames}", **style)
        for frames, colour in (("all frames", "0.8"), ("the class", _views.MEAN_COLOUR))
    ]
    _views.add_legend(display.figure_, entries, whole.skeleton)
    return display
