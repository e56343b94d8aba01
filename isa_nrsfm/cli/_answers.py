"""What a fit says of the other columns of a table: labels, groups and times."""

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import PCA

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._dynamics.sequences import sequences_of
from isa_nrsfm._tables.frame_columns import checked_times, group_numbers
from isa_nrsfm.analysis import (
    AlignedFrames,
    WithinGroups,
    association,
    between_share,
    predictability,
)
from isa_nrsfm.analysis._labels import kind_of, refuse_infinite
from isa_nrsfm.cli._frames import Frames, column_named
from isa_nrsfm.cli._outputs import component_names, figure_named, write_figure
from isa_nrsfm.cli._progress import show_stage
from isa_nrsfm.export import point_distances
from isa_nrsfm.export._poses import point_numbers

if TYPE_CHECKING:
    import pandas as pd


TIME_FIGURE = "time.png"
# Classes whose mean shapes are drawn on a page, at most.
MOST_SHAPES = 12


class Label(NamedTuple):
    """
    A column that says what the frames show.

    Attributes
    ----------
    name : str
        Of the column.
    kind : {"classes", "number"}
        What it has.
    values : ndarray of shape (n_known,)
        Its entries, where there are any.
    known : ndarray of bool, shape (n_frames,)
        The frames that have one.
    """

    name: str
    kind: Literal["classes", "number"]
    values: NDArray
    known: NDArray


class Answers(NamedTuple):
    """
    The columns of a table that a fit is asked about, for its usable frames.

    Attributes
    ----------
    labels : list of Label
        As many as were asked for.
    group : str or None
        Name of the column of groups.
    groups : ndarray of shape (n_frames,) or None
        Its entries.
    time : str or None
        Name of the column of times, or "seconds" for frames in order.
    times : ndarray of shape (n_frames,) or None
        Times of the frames.
    distances : list of (int, int)
        Pairs of points whose distances are asked for.
    unit : tuple of (int, int) or None
        Points whose distance is the unit.
    length : float
        Its length.
    """

    labels: list[Label]
    group: str | None
    groups: NDArray | None
    time: str | None
    times: NDArray | None
    distances: list[tuple[int, int]]
    unit: tuple[int, int] | None
    length: float


def asked_for(args: Namespace, frames: Frames) -> Answers:
    """
    Return the columns that the options --label, --group, --time and --fps name.

    Raises
    ------
    ValueError
        If there is no such column, or if it cannot answer: a label of one class or with
        all entries different, missing groups, times that are missing or do not rise.
    """
    table = frames.other[frames.usable]
    labels = [_label(table, text) for text in args.label]
    groups = times = time = None
    if args.group is not None:
        column = _cells(table, args.group, "--group")
        empty = int(column.isna().sum())
        if empty:
            raise ValueError(
                f"--group: {empty} of {len(column)} frames have no {args.group!r}"
            )
        groups = column.to_numpy()
    if args.time is not None:
        time, times = args.time, _times(_cells(table, args.time, "--time"))
    elif args.fps is not None:
        time, times = (
            "seconds",
            np.asarray(frames.points.index[frames.usable]) / args.fps,
        )
    if times is not None:
        _check_order(times, groups, time)
    names = frames.columns.points
    distances = [_numbered(pair, names, "--distance") for pair in args.distance]
    unit = None if args.unit is None else _numbered(args.unit, names, "--unit")
    if unit is not None and not distances:
        raise ValueError("--unit is for --distance")
    return Answers(
        labels, args.group, groups, time, times, distances, unit, args.length
    )


def _numbered(
    pair: tuple[str, str], names: Sequence[str], option: str
) -> tuple[int, int]:
    """Return the numbers of two points."""
    try:
        return point_numbers(pair, names)
    except ValueError as error:
        raise ValueError(f"{option} {','.join(pair)}: {error}") from error


def _label(table: "pd.DataFrame", text: str) -> Label:
    """Return the label of COLUMN, COLUMN:classes or COLUMN:number."""
    name, colon, kind = text.rpartition(":")
    if not colon or kind not in ("classes", "number"):
        name, kind = text, "auto"
    column = _cells(table, name, "--label")
    known = column.notna().to_numpy()
    values = column[known].to_numpy()
    if values.dtype.kind not in "biuf":
        values = values.astype(str)
    if not len(values):
        raise ValueError(f"--label: no frame has a {name!r}")
    refuse_infinite(f"--label {text}", values, table.index[known].to_numpy())
    try:
        found = kind_of(values, kind)
    except ValueError as error:
        raise ValueError(f"--label {text}: {error}") from error
    return Label(name, found, values, known)


def _cells(table: "pd.DataFrame", name: str, option: str) -> "pd.Series":
    """Return a column with numbers where all cells are, and NA for empty cells."""
    pd = import_optional("pandas", extra="io")
    column = column_named(table, name, option)
    if column.dtype == object or pd.api.types.is_string_dtype(column):
        text = column.where(column.notna(), "").astype(str).str.strip()
        column = column.where(text != "")
        numbers = pd.to_numeric(text.where(text != ""), errors="coerce")
        if (numbers.isna() == column.isna()).all():
            return numbers
    return column


def _times(column: "pd.Series") -> NDArray:
    """Return a column as numbers, or as dates where it is none of numbers."""
    pd = import_optional("pandas", extra="io")
    if pd.api.types.is_numeric_dtype(column):
        return column.to_numpy(dtype=float, na_value=np.nan)
    dates = pd.to_datetime(column, errors="coerce", format="mixed")
    wrong = dates.isna() & column.notna()
    if wrong.any():
        first = f"row {wrong.idxmax()}: {column[wrong].iloc[0]!r}"
        raise ValueError(
            f"--time: expected numbers or dates; {wrong.sum()} of {len(column)} frames "
            f"have neither, the first is {first}"
        )
    return np.asarray(dates.to_numpy())


def _check_order(times: NDArray, groups: NDArray | None, name: str | None) -> None:
    """Raise unless times rise within each group."""
    try:
        sequences_of(
            checked_times(times, len(times)), group_numbers(groups, len(times)), 1
        )
    except ValueError as error:
        hint = (
            "" if groups is not None else " (--group says which rows belong together)"
        )
        raise ValueError(f"--time {name}: {error}{hint}") from error


def first_classes(asked: Answers, X: "pd.DataFrame") -> "pd.Series | None":
    """Return the first label of few classes: the viewer colours the frames by it."""
    from isa_nrsfm.export._viewer import MOST_LABELS

    pd = import_optional("pandas", extra="io")
    for label in asked.labels:
        few = len(np.unique(label.values)) <= MOST_LABELS
        if label.kind == "classes" and few:
            values = pd.Series(None, index=X.index, dtype=object, name=label.name)
            values[label.known] = [str(value) for value in label.values]
            return values
    return None


class Answered(NamedTuple):
    """
    What a fit says of these columns.

    Attributes
    ----------
    report : dict
        For the report: the entries "labels", "groups" and "time" that were asked for.
    alpha : DataFrame
        Further columns of the table of coefficients, for the usable frames.
    smooth : SmoothedCoefficients or None
        The coefficients smoothed in time.
    """

    report: dict[str, Any]
    alpha: "pd.DataFrame"
    smooth: Any


def answered(
    asked: Answers, estimator: AffineNRSfM, X: "pd.DataFrame", random_state: int
) -> Answered:
    """Return what a fit says of the columns that it is asked about."""
    pd = import_optional("pandas", extra="io")
    alpha, names = estimator.alpha_, component_names(len(estimator.basis_))
    report: dict[str, Any] = {}
    columns: dict[str, NDArray] = {}
    smooth = None
    if asked.labels:
        aligned = _aligned_pca(estimator, X)
        report["labels"] = [
            _label_report(label, alpha, aligned, asked, random_state)
            for label in asked.labels
        ]
    if asked.groups is not None:
        report["groups"] = _group_report(asked, alpha)
        relative = WithinGroups().fit_transform(alpha, groups=asked.groups)
        columns |= dict(zip([f"{n}_within" for n in names], relative.T, strict=True))
    if asked.times is not None and estimator.refinement == "joint":
        show_stage("smoothing")
        smooth = estimator.smooth(X, time=asked.times, groups=asked.groups)
        report["time"] = {
            "column": asked.time,
            "time_scales": smooth.time_scales,
            "changed_by": np.sqrt(np.nanmean((smooth.alpha - alpha) ** 2)),
        }
        columns |= dict(
            zip([f"{n}_smooth" for n in names], smooth.alpha.T, strict=True)
        )
    if asked.distances:
        columns |= _distances(asked, estimator, X)
    return Answered(report, pd.DataFrame(columns, index=X.index), smooth)


def _distances(
    asked: Answers, estimator: AffineNRSfM, X: "pd.DataFrame"
) -> dict[str, NDArray]:
    """Return the distances that are asked for, with a warning where they are unsure."""
    try:
        found = point_distances(
            estimator, asked.distances, unit=asked.unit, length=asked.length
        )
    except ValueError as error:
        warn_caller(f"alpha.csv has no distances: {error}")
        return {}
    names = [f"distance_{a}_{b}" for a, b in asked.distances]
    return dict(zip(names, found.T, strict=True))


def _aligned_pca(estimator: AffineNRSfM, X: "pd.DataFrame") -> NDArray:
    """Return as many principal components of the aligned table as there are shapes.

    Missing points are those of the model.
    """
    table = X.to_numpy(dtype=float)
    missing = np.isnan(table)
    if missing.any():
        table = np.where(missing, estimator.reproject(X), table)
    aligned = AlignedFrames().fit_transform(table)
    most = min(len(estimator.basis_), *aligned.shape)
    return np.asarray(PCA(most, random_state=0).fit_transform(aligned))


def _label_report(
    label: Label,
    alpha: NDArray,
    aligned: NDArray,
    asked: Answers,
    random_state: int,
) -> dict[str, Any]:
    """Return how coefficients go with a label."""
    known = label.known
    options: dict[str, Any] = {
        "y": label.values,
        "groups": None if asked.groups is None else asked.groups[known],
        "time": None if asked.times is None else asked.times[known],
        "kind": label.kind,
        "random_state": random_state,
    }
    found = association(alpha[known], **options)
    report: dict[str, Any] = {
        "column": label.name,
        "kind": label.kind,
        "n_frames": found.n_frames,
        "n_without_label": int(np.sum(~known)),
        "statistic": "eta_squared" if label.kind == "classes" else "spearman",
        "values": found.statistic,
        "p_values": found.p_value,
        "permuted": found.permuted,
        "score": "accuracy" if label.kind == "classes" else "r_squared",
    }
    if label.kind == "classes":
        counts = np.unique(label.values, return_counts=True)
        report["classes"] = {str(c): int(n) for c, n in zip(*counts, strict=True)}
        report["largest_class"] = counts[1].max() / len(label.values)
        report["class_means"] = dict(
            zip(report["classes"], _class_means(label, alpha), strict=True)
        )
    try:
        report["cross_validated"] = predictability(alpha[known], **options).mean()
        report["cross_validated_pca"] = predictability(aligned[known], **options).mean()
    except ValueError as error:  # too few frames of a class, or groups, for two folds
        report["not_cross_validated"] = str(error)
    return report


def _class_means(label: Label, alpha: NDArray) -> NDArray:
    """Return the mean coefficients of each class (n_classes, K), in deviations.

    They are relative to the mean over all frames. alpha is (n_frames, K).
    """
    deviation = alpha.std(axis=0)
    standard = np.zeros_like(alpha)
    np.divide(alpha - alpha.mean(axis=0), deviation, where=deviation > 0, out=standard)
    of_class = label.values == np.unique(label.values)[:, None]
    return of_class @ standard[label.known] / of_class.sum(axis=1, keepdims=True)


def _group_report(asked: Answers, alpha: NDArray) -> dict[str, Any]:
    """Return how much of the variance of each coefficient lies between groups."""
    report: dict[str, Any] = {"column": asked.group}
    try:
        share = between_share(alpha, asked.groups)
    except ValueError as error:  # one group, or groups of one frame
        return report | {"not_divided": str(error)}
    return report | {
        "n_groups": share.n_groups,
        "between": share.between,
        "within": share.within,
    }


def answer_figures(asked: Answers) -> dict[str, str]:
    """Return the names of the figures, and what they show."""
    figures = {
        _label_figure(number): f"coefficients by {label.name}"
        for number, label in enumerate(asked.labels)
    }
    figures |= {
        _shapes_figure(number): f"mean shape of each {label.name}, beside that of all "
        "frames in grey"
        for number, label in enumerate(asked.labels)
        if _has_shapes(label)
    }
    if asked.times is not None:
        figures[TIME_FIGURE] = "coefficients in time, with one standard deviation"
    return figures


def _label_figure(number: int) -> str:
    """Return the name of the figure of a label."""
    return f"label_{number + 1}.png"


def _shapes_figure(number: int) -> str:
    """Return the name of the figure of the mean shapes of a label."""
    return f"label_{number + 1}_shapes.png"


def _has_shapes(label: Label) -> bool:
    """Tell whether a label has few enough classes for a figure of their shapes."""
    few = len(np.unique(label.values)) <= MOST_SHAPES
    return label.kind == "classes" and few


def draw_answers(
    folder: Path,
    asked: Answers,
    answers: Answered,
    estimator: AffineNRSfM,
    **drawn: Any,
) -> None:
    """Draw the coefficients by label, and in time: smoothed where they are."""
    from isa_nrsfm.plotting import CoefficientsDisplay

    names = component_names(len(estimator.basis_))
    for number, label in enumerate(asked.labels):
        display = CoefficientsDisplay(
            alpha=estimator.alpha_[label.known],
            y=label.values,
            label=label.name,
            component_names=names,
        )
        with figure_named(name := _label_figure(number)):
            write_figure(folder / name, display.plot(kind=label.kind).figure_)
        if _has_shapes(label):
            with figure_named(name := _shapes_figure(number)):
                write_figure(folder / name, _draw_shapes(label, estimator, drawn))
    if asked.times is not None:
        alpha, deviation = estimator.alpha_, getattr(estimator, "alpha_std_", None)
        if answers.smooth is not None:
            alpha, deviation, _ = answers.smooth
        display = CoefficientsDisplay(
            alpha=alpha,
            alpha_std=deviation,
            time=asked.times,
            groups=asked.groups,
            component_names=names,
        )
        with figure_named(TIME_FIGURE):
            write_figure(folder / TIME_FIGURE, display.plot(kind="time").figure_)


def _draw_shapes(label: Label, estimator: AffineNRSfM, options: dict[str, Any]) -> Any:
    """Draw the mean shape of each class over that of all frames."""
    from isa_nrsfm.plotting import BasisShapeDisplay
    from isa_nrsfm.plotting._axes import MEAN_COLOUR, wrap_title
    from isa_nrsfm.plotting._page import VIEWS, block_limits, new_page

    whole = BasisShapeDisplay.from_estimator(estimator, **options)
    import_optional("matplotlib.pyplot", extra="plot").close(whole.figure_)
    means = _class_means(label, estimator.alpha_)
    shapes = whole.mean_shape + np.tensordot(means, whole.basis, 1)
    everything = np.concatenate([whole.mean_shape[None], shapes])
    (limits,), _ = block_limits([everything])
    axes = new_page(len(shapes), np.ptp(limits, axis=1), None).reshape(-1, 2)
    classes, counts = np.unique(label.values, return_counts=True)
    for shape, pair, name, count in zip(shapes, axes, classes, counts, strict=True):
        for drawn, colour in ((whole.mean_shape, "0.8"), (shape, MEAN_COLOUR)):
            BasisShapeDisplay(
                mean_shape=drawn,
                basis=np.zeros((0, *drawn.shape)),
                edges=whole.skeleton,
                origin=whole.origin,
            ).plot(pair, point_kw={"color": colour})
        for axis, (x, y) in zip(pair, VIEWS, strict=True):
            axis.set(xlim=limits[x], ylim=limits[y])
            axis.yaxis.set_inverted(whole.origin == "upper")
        title = wrap_title(f"{name} ({count} frames)", pair)
        pair[0].set_title(title, loc="left", fontsize="small")
    return axes[0, 0].figure
