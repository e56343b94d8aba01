"""Labels, groups, times and distances: the other columns that a fit is asked about."""

from argparse import Namespace
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import PCA

from isa_nrsfm import AffineNRSfM, analysis
from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.damaged_files import errors_of
from isa_nrsfm._parameters.choices import JOINT_REFINEMENTS
from isa_nrsfm.analysis._frame_columns import (
    checked_times,
    group_numbers,
    kind_of,
    refuse_infinite,
    sequences_of,
)
from isa_nrsfm.cli._outputs import fitted_table
from isa_nrsfm.cli._progress import show_stage
from isa_nrsfm.cli._reading import Frames, cells_of, column_named
from isa_nrsfm.cli._times import read_times, video_times
from isa_nrsfm.export import point_distances
from isa_nrsfm.export._poses import point_numbers


class Label(NamedTuple):
    """A column with classes or numbers; values (n_known,), known (n_frames,)."""

    name: str
    kind: Literal["classes", "number"]
    values: NDArray
    known: NDArray

    def is_of_classes(self, most: int) -> bool:
        """Return whether the label has at most so many classes."""
        return self.kind == "classes" and len(np.unique(self.values)) <= most


class Columns(NamedTuple):
    """The columns that a fit is asked about, for its usable frames."""

    labels: list[Label]
    groups: NDArray | None
    times: NDArray | None
    time_unit: str
    distances: list[tuple[int, int]]
    unit: tuple[int, int] | None


def asked_columns(args: Namespace, frames: Frames) -> Columns:
    """Return the columns that the options name; raise if they cannot be used."""
    table, names = frames.other[frames.usable], frames.columns.points
    labels = [_label(table, text) for text in args.label]
    groups = None if args.group is None else _groups(table, args.group)
    times, unit_of_times = None, "seconds"
    if args.time_format is not None and args.time is None:
        raise ValueError("--time-format needs --time")
    if args.time is not None:
        with errors_of(f"--time {args.time}"):
            cells = cells_of(table, args.time, "--time")
            times, unit_of_times = read_times(cells, args.time_format)
    elif args.fps is not None:
        images, name = frames.images
        numbers = pd.Series(images, frames.other.index)[frames.usable]
        times = video_times(numbers, name, groups) / args.fps
    if times is not None:
        try:
            times_in_seconds = checked_times(times, len(table))
            sequences_of(times_in_seconds, group_numbers(groups, len(table)), 1)
        except ValueError as error:
            hint = " (--group: the rows that belong together)" * (groups is None)
            option = "--fps" if args.time is None else f"--time {args.time}"
            raise ValueError(f"{option}: {error}{hint}") from error
    distances = [_numbered(pair, names, "--distance") for pair in args.distance]
    unit = None if args.unit is None else _numbered(args.unit, names, "--unit")
    if unit is not None and not distances:
        raise ValueError("--unit needs --distance")
    if distances and unit is None and len(names) != 68:
        raise ValueError(
            f"--distance needs --unit: the {len(names)} points are not the 68 of a "
            "face, whose outer corners of the eyes are the unit. Give two points, such "
            f"as --unit {names[0]},{names[1]}"
        )
    return Columns(labels, groups, times, unit_of_times, distances, unit)


def column_results(
    args: Namespace, asked: Columns, estimator: AffineNRSfM, frames: Frames
) -> tuple[dict[str, Any], "pd.DataFrame", Any]:
    """Return entries of the report, columns of alpha.csv and smoothed coefficients."""
    X, alpha, smooth = frames.X, estimator.alpha_, None
    report: dict[str, Any] = {}
    columns: dict[str, NDArray] = {}
    if asked.labels:
        features = {"alpha": alpha} | _aligned_pca(estimator, X)
        report["labels"] = [
            _label_report(label, features, asked, args.random_state)
            for label in asked.labels
        ]
    if asked.groups is not None:
        report["groups"] = {"column": args.group}
        try:
            report["groups"] |= analysis.between_share(alpha, asked.groups)._asdict()
        except ValueError as error:  # one group, or groups of one frame
            report["groups"]["not_divided"] = str(error)
        within = analysis.WithinGroups().fit_transform(alpha, groups=asked.groups)
        columns |= {f"alpha_{k}_within": each for k, each in enumerate(within.T, 1)}
    if asked.times is not None and estimator.refinement in JOINT_REFINEMENTS:
        show_stage("smoothing")
        smooth = estimator.smooth(
            X, time=asked.times, groups=asked.groups, **frames.weighting
        )
        found = smooth.alpha
        report["time"] = {
            "column": args.time or "seconds",
            "unit": asked.time_unit,
            "time_scales": smooth.time_scales,
            "changed_by": np.sqrt(np.nanmean((found - alpha) ** 2)),
        }
        columns |= {f"alpha_{k}_smooth": each for k, each in enumerate(found.T, 1)}
    if asked.distances:
        names = [f"distance_{a}_{b}" for a, b in asked.distances]
        try:
            found = point_distances(
                estimator, asked.distances, unit=asked.unit, length=args.length
            )
            columns |= zip(names, found.T, strict=True)
        except ValueError as error:
            warn_caller(f"alpha.csv has no distances: {error}")
    return report, X[[]].assign(**columns), smooth


def class_means(label: Label, alpha: NDArray) -> dict[str, NDArray]:
    """Return the mean of the standardised coefficients in each class."""
    deviation, y = alpha.std(axis=0), label.values
    standard = (alpha - alpha.mean(axis=0)) / np.where(deviation > 0, deviation, np.inf)
    known = standard[label.known]
    return {str(name): known[y == name].mean(axis=0) for name in np.unique(y)}


def _numbered(
    pair: tuple[str, str], names: Sequence[str], option: str
) -> tuple[int, int]:
    """Return the numbers of two points."""
    with errors_of(f"{option} {','.join(pair)}"):
        return point_numbers(pair, names)


def _label(table: "pd.DataFrame", text: str) -> Label:
    """Return the label of COLUMN, COLUMN:classes or COLUMN:number."""
    name, colon, kind = text.rpartition(":")
    if not colon or kind not in ("classes", "number"):
        name, kind = text, "auto"
    column = cells_of(table, name, "--label")
    known = column.notna()
    names = _names(column[known])
    if names.empty:
        raise ValueError(f"--label: no frame has a {name!r}")
    numbers = pd.to_numeric(names, errors="coerce")
    if kind == "auto" and numbers.notna().all() and (numbers % 1 != 0).any():
        kind = "number"
    if kind == "number" and numbers.isna().any():
        row = numbers.isna().idxmax()
        raise ValueError(
            f"--label {text}: labels must be numbers; got {names[row]!r} in row {row}"
        )
    values = (numbers if kind == "number" else names).to_numpy()
    if values.dtype.kind not in "biuf":
        values = values.astype(str)
    refuse_infinite(f"--label {text}", values, table.index[known].to_numpy())
    with errors_of(f"--label {text}"):
        return Label(name, kind_of(values, kind), values, known.to_numpy())


def _groups(table: "pd.DataFrame", name: str) -> NDArray:
    """Return the column with the group of each frame."""
    column = cells_of(table, name, "--group")
    missing = column.isna()
    if missing.any():
        cell = column_named(table, name, "--group")[missing].iloc[0]
        raise ValueError(
            f"--group: {missing.sum()} of {len(column)} frames have no {name!r} "
            f"(first: row {missing.idxmax()}, {cell!r}); name the group of each frame, "
            "or leave these rows out with --skip-rows"
        )
    return np.asarray(_names(column).to_numpy())


def _names(known: "pd.Series") -> "pd.Series":
    """Return texts as they are, or as numbers if these are written the same."""
    if known.dtype.kind in "mM":  # dates
        return known.astype(str)
    numbers = pd.to_numeric(known, errors="coerce")
    return numbers if numbers.astype(str).equals(known.astype(str)) else known


def _aligned_pca(estimator: AffineNRSfM, X: "pd.DataFrame") -> dict[str, NDArray]:
    """Return K and 3K + 3 principal components of the aligned table, points filled in.

    Of as many components as coefficients, and of the rank of the model.
    """
    table = np.where(X.isna(), fitted_table(estimator), X)
    aligned = analysis.AlignedFrames().fit_transform(table)
    n_shapes = len(estimator.basis_)
    most = min(3 * n_shapes + 3, *aligned.shape)
    scores = PCA(most, random_state=0).fit_transform(aligned)
    return {"pca": scores[:, :n_shapes], "pca_of_rank": scores}


def _label_report(
    label: Label, features: dict[str, NDArray], asked: Columns, random_state: int
) -> dict[str, Any]:
    """Return the association of coefficients with a label."""
    alpha = features["alpha"]
    known, classes = label.known, label.kind == "classes"
    options: dict[str, Any] = {
        "y": label.values,
        "groups": None if asked.groups is None else asked.groups[known],
        "time": None if asked.times is None else asked.times[known],
        "kind": label.kind,
        "random_state": random_state,
    }
    found = analysis.association(alpha[known], **options)
    report: dict[str, Any] = {
        "column": label.name,
        "kind": label.kind,
        "n_frames": found.n_frames,
        "n_without_label": np.sum(~known),
        "statistic": "eta_squared" if classes else "spearman",
        "values": found.statistic,
        "p_values": found.p_value,
        "permuted": found.permuted,
        "untested": found.untested,
        "score": "accuracy" if classes else "r_squared",
    }
    if classes:
        names, counts = np.unique(label.values, return_counts=True)
        report["classes"] = dict(zip(map(str, names), counts, strict=True))
        report["largest_class"] = counts.max() / len(label.values)
        report["class_means"] = class_means(label, alpha)
    try:
        for name, values in features.items():
            scores = analysis.predictability(values[known], **options)
            key = "cross_validated" + f"_{name}" * (name != "alpha")
            report[key], n = scores.mean(), len(scores)
            report[f"{key}_standard_error"] = scores.std(ddof=1) / np.sqrt(n)
            report[f"{key}_n_features"] = values.shape[1]
    except ValueError as error:  # too few frames of a class, or groups, for two folds
        report["not_cross_validated"] = str(error)
    return report
