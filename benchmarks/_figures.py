"""Pictures of the comparison: reprojections, bars of errors, curves of recovery."""

from pathlib import Path

import numpy as np

from benchmarks._markdown import ROUNDING, found, number, select
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.plotting import ReprojectionDisplay
from isa_nrsfm.plotting._axes import is_dense

# The palette of Okabe and Ito, one colour a method; the last one is grey.
COLOURS = {
    "joint": "#D55E00",
    "weak_perspective": "#F0E442",
    "orthographic": "#000000",
    "isa1": "#56B4E9",
    "isa2": "#0072B2",
    "pi": "#CC79A7",
    "bmm": "#009E73",
    "kong_lucey": "#E69F00",
    "rigid": "0.6",
    "floor": "0.6",
}
OTHER_COLOUR = "0.6"
MARKERS = {
    "joint": "o",
    "isa1": "s",
    "isa2": "^",
    "pi": "v",
    "bmm": "D",
    "kong_lucey": "P",
}
BAR_HEIGHT, PANEL_WIDTH, PANEL_HEIGHT, LABEL_WIDTH = 0.27, 2.7, 1.9, 1.9  # inches
MOST_COLUMNS = 4
DOTS_PER_INCH, N_COLOURS = 110, 64
# Logarithmic axes end this far below the largest number, for errors that are rounding.
LEAST_SHARE = 1e-5


def pyplot():
    """Return matplotlib's pyplot, drawing to files."""
    import_optional("matplotlib", extra="plot").use("Agg")
    return import_optional("matplotlib.pyplot", extra="plot")


def save(figure, path):
    """Write a figure, with few colours, and forget it."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DOTS_PER_INCH)
    pyplot().close(figure)
    image = import_optional("PIL.Image", extra="plot")
    with image.open(path) as picture:
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
    if not rows:
        return
    n_frames = len(shown[rows[0]]["frames"])
    observed = shown[rows[0]]["observed"]
    size = np.median(np.ptp(observed, axis=1), axis=0)
    width = 1.9
    height = width * float(np.clip(size[1] / size[0], 0.45, 1.3)) + 0.35
    figure, axes = pyplot().subplots(
        len(rows),
        n_frames,
        squeeze=False,
        figsize=(LABEL_WIDTH + width * n_frames, height * len(rows) + 0.8),
        layout="constrained",
    )
    for n, (name, row) in enumerate(zip(rows, axes, strict=True)):
        display = ReprojectionDisplay(**shown[name], edges="auto", origin=origin).plot(
            row
        )
        for i, panel in enumerate(row):
            # All methods on the same scale, however far they miss.
            low, high = observed[i].min(axis=0), observed[i].max(axis=0)
            margin = 0.15 * (high - low).max()
            panel.set(xlim=(low[0] - margin, high[0] + margin))
            bounds = low[1] - margin, high[1] + margin
            panel.set_ylim(bounds[::-1] if panel.yaxis.get_inverted() else bounds)
            panel.set_aspect("equal", adjustable="box")
            if n:  # the number of the frame stands above the first row
                error = panel.get_title().partition("\n")[2]
                panel.set_title(error, fontsize="small")
        row[0].set_ylabel(
            titles[name].replace(", ", ",\n"), rotation=0, ha="right", va="center"
        )
    figure.suptitle(heading, fontsize="medium")
    figure.legend(
        handles=[display.observed_[0], display.reprojected_[0]],
        loc="outside lower center",
        ncols=2,
        frameon=False,
        markerscale=4.0 if is_dense(observed[0]) else 1.0,
    )
    save(figure, path)


def draw_bars(records, row_titles, column_titles, measure, path, *, label, log=True):
    """
    Draw a panel a set with a bar a method, from the smallest to the largest of seeds.

    Parameters
    ----------
    records : list of Record
        Of a section.
    row_titles, column_titles : dict of str
        Titles of methods and sets, in order.
    measure : callable
        Returns a number of a record, or None.
    path : path-like
        The png file.
    label : str
        Name and unit of the numbers.
    log : bool, default=True
        Whether the axis is logarithmic.
    """
    columns = [
        name for name in column_titles if found(select(records, set=name), measure)
    ]
    rows = [name for name in row_titles if found(select(records, method=name), measure)]
    if not columns:
        return
    n_columns = min(MOST_COLUMNS, len(columns))
    n_rows = -(-len(columns) // n_columns)
    figure, axes = pyplot().subplots(
        n_rows,
        n_columns,
        squeeze=False,
        sharey=True,
        figsize=(
            LABEL_WIDTH + PANEL_WIDTH * n_columns,
            (BAR_HEIGHT * len(rows) + 0.9) * n_rows,
        ),
        layout="constrained",
    )
    for name, panel in zip(columns, axes.ravel(), strict=False):
        for place, method in enumerate(rows):
            of_one = select(records, set=name, method=method)
            values = found(of_one, measure)
            if values:
                _draw_bar(panel, place, values, COLOURS.get(method, OTHER_COLOUR))
            elif of_one:
                text = of_one[0].message if of_one[0].status == "over time" else "none"
                panel.annotate(
                    text,
                    (0.02, place),
                    xycoords=("axes fraction", "data"),
                    va="center",
                    fontsize="small",
                )
        panel.set_title(column_titles[name], fontsize="medium")
        if log:
            _set_decades(panel, found(select(records, set=name), measure))
        panel.set_yticks(range(len(rows)), [row_titles[row] for row in rows])
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(axis="x", linewidth=0.4, alpha=0.6)
        panel.set_axisbelow(True)
    axes[0, 0].invert_yaxis()
    for unused in axes.ravel()[len(columns) :]:
        figure.delaxes(unused)
    figure.supxlabel(label, fontsize="medium")
    save(figure, path)


def _draw_bar(panel, place, values, colour):
    """Draw the median as a bar and the range as a line."""
    least, median, most = np.percentile(values, (0, 50, 100))
    panel.barh(place, median, color=colour, height=0.7)
    panel.plot((least, most), (place, place), color="black", linewidth=1.0)
    if median >= ROUNDING:
        text, style = f" {number(median)}", {"va": "center", "fontsize": "x-small"}
        panel.annotate(text, (most, place), **style)


def _set_decades(panel, values):
    """Make the axis logarithmic, over the decades that the numbers are in."""
    counted = [v for v in values if v > LEAST_SHARE * max(values)]
    decades = np.log10([min(counted), max(counted)])
    panel.set_xscale("log")
    panel.set_xlim(10 ** np.floor(decades[0] - 0.05), 10 ** np.ceil(decades[1] + 0.05))
    panel.minorticks_off()


def draw_curves(panels, titles, path, *, measures, log=False):
    """
    Draw a column a setting and a row a measure, with a curve a method.

    Parameters
    ----------
    panels : list of tuple
        Label of the axis, and a dict from each setting to its records.
    titles : dict of str
        Titles of the methods, in order.
    path : path-like
        The png file.
    measures : dict of callable
        By name and unit, what returns a number of a record, or None. Curves are
        medians over the seeds, with their range.
    log : bool, default=False
        Whether both axes are logarithmic. Otherwise settings are evenly spaced.
    """
    figure, axes = pyplot().subplots(
        len(measures),
        len(panels),
        squeeze=False,
        sharex="col",
        sharey="row",
        figsize=(
            1.25 * PANEL_WIDTH * len(panels),
            1.5 * PANEL_HEIGHT * len(measures) + 0.5,
        ),
        layout="constrained",
    )
    for (label, measure), row in zip(measures.items(), axes, strict=True):
        for (_, settings), panel in zip(panels, row, strict=True):
            _draw_curves_of(panel, settings, titles, measure, log)
        row[0].set_ylabel(label)
    for (axis, _), panel in zip(panels, axes[-1], strict=True):
        panel.set_xlabel(axis)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(labels), frameon=False
    )
    save(figure, path)


def _draw_curves_of(panel, settings, titles, measure, log):
    """Draw a curve a method in a panel."""
    places = settings if log else range(len(settings))
    for method in titles:
        points = [
            (place, *np.percentile(values, (0, 50, 100)))
            for place, records in zip(places, settings.values(), strict=True)
            if (values := found(select(records, method=method), measure))
        ]
        if not points:
            continue
        at, least, median, most = np.array(points).T
        colour = COLOURS.get(method, OTHER_COLOUR)
        panel.plot(
            at,
            median,
            color=colour,
            marker=MARKERS.get(method, "x"),
            markersize=5,
            label=titles[method],
        )
        panel.fill_between(at, least, most, color=colour, alpha=0.15, lw=0)
    if log:
        panel.set(xscale="log", yscale="log")
    else:
        panel.set_xticks(places, [f"{setting:g}" for setting in settings])
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(linewidth=0.4, alpha=0.6)
