"""Pictures of the comparison: reprojections, curves of recovery and cost."""

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from benchmarks._results import select
from isa_nrsfm.plotting import ReprojectionDisplay

# The palette of Okabe and Ito, one colour a method; the others are grey.
COLOURS = {
    "joint": "#D55E00",
    "weak_perspective": "#F0E442",
    "orthographic": "#000000",
    "isa1": "#56B4E9",
    "isa2": "#0072B2",
    "pi": "#CC79A7",
    "bmm": "#009E73",
    "kong_lucey": "#E69F00",
}
OTHER_COLOUR = "0.6"
PANEL_WIDTH, PANEL_HEIGHT, LABEL_WIDTH = 2.7, 1.9, 1.9  # inches
DOTS_PER_INCH, N_COLOURS = 110, 64


def save(figure, path):
    """Write a figure, with few colours."""
    figure.savefig(path, dpi=DOTS_PER_INCH)
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(N_COLOURS).save(path, optimize=True)


def draw_reprojections(shown, titles, heading, path, origin="auto"):
    """
    Draw observed and reprojected points, a row a method and a column a frame.

    Parameters
    ----------
    shown : dict of dict
        For each method the frames (n_frames,), and the observed and reprojected
        points (n_frames, n_points, 2).
    titles : dict of str
        Titles of the methods, in the order of the rows.
    heading : str
        Title of the figure.
    path : path-like
        The png file.
    origin : {"auto", "upper", "lower"}, default="auto"
        Where y is zero.
    """
    rows = [name for name in titles if name in shown]
    observed = shown[rows[0]]["observed"]
    size = np.median(np.ptp(observed, axis=1), axis=0)
    width = 1.9
    height = width * float(np.clip(size[1] / size[0], 0.45, 1.3)) + 0.35
    size = LABEL_WIDTH + width * len(observed), height * len(rows) + 0.8
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(rows), len(observed), squeeze=False)
    for name, row in zip(rows, axes, strict=True):
        display = ReprojectionDisplay(**shown[name], edges="auto", origin=origin)
        display.plot(row)
        for points, panel in zip(observed, row, strict=True):
            # All methods on the same scale, however far they miss.
            low, high = points.min(axis=0), points.max(axis=0)
            margin = 0.15 * (high - low).max()
            bounds = low[1] - margin, high[1] + margin
            panel.set(
                xlim=(low[0] - margin, high[0] + margin),
                ylim=bounds[::-1] if panel.yaxis.get_inverted() else bounds,
            )
            panel.set_aspect("equal", adjustable="box")
            if name != rows[0]:  # the number of the frame stands above the first row
                error = panel.get_title().partition("\n")[2]
                panel.set_title(error, fontsize="small")
        row[0].set_ylabel(
            titles[name].replace(", ", ",\n"), rotation=0, ha="right", va="center"
        )
    figure.suptitle(heading, fontsize="medium")
    handles = [display.observed_[0], display.reprojected_[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    save(figure, path)


def draw_curves(panels, titles, measures, path, log=False):
    """
    Draw a column a setting and a row a measure, with a curve a method.

    Parameters
    ----------
    panels : dict of tuple
        By label of the axis, the name of a column and the records in which it varies.
    titles : dict of str
        Titles of the methods, in order.
    measures : dict of str
        Columns, by name and unit. Curves are medians over the seeds, with their range.
    path : path-like
        The png file.
    log : bool, default=False
        Whether both axes are logarithmic. Otherwise settings are evenly spaced.
    """
    size = 1.25 * PANEL_WIDTH * len(panels), 1.5 * PANEL_HEIGHT * len(measures) + 0.5
    figure = Figure(figsize=size, layout="constrained")
    n_rows, n_columns = len(measures), len(panels)
    axes = figure.subplots(n_rows, n_columns, squeeze=False, sharex="col", sharey="row")
    for (label, measure), row in zip(measures.items(), axes, strict=True):
        row[0].set_ylabel(label)
        for (name, records), panel in zip(panels.values(), row, strict=True):
            settings = sorted(records[name].unique())
            for method in titles:
                groups = select(records, method=method).groupby(name)[measure]
                low, middle, high = (groups.quantile(q).dropna() for q in (0, 0.5, 1))
                if middle.empty:
                    continue
                at = middle.index if log else [settings.index(s) for s in middle.index]
                colour = COLOURS.get(method, OTHER_COLOUR)
                panel.plot(at, middle, "o-", ms=5, color=colour, label=titles[method])
                panel.fill_between(at, low, high, color=colour, alpha=0.15, lw=0)
            if log:
                panel.set(xscale="log", yscale="log")
            else:
                panel.set_xticks(range(len(settings)), [f"{s:g}" for s in settings])
            panel.spines[["top", "right"]].set_visible(False)
            panel.grid(linewidth=0.4, alpha=0.6)
    for axis, panel in zip(panels, axes[-1], strict=True):
        panel.set_xlabel(axis)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    place = {"loc": "outside lower center", "ncols": len(labels), "frameon": False}
    figure.legend(handles, labels, **place)
    save(figure, path)
