"""Labels, groups, times and distances: the other columns that a fit is asked about."""

from argparse import Namespace
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM, analysis
from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import errors_of
from isa_nrsfm._parameters import JOINT_REFINEMENTS
from isa_nrsfm.analysis import _frame_columns
from isa_nrsfm.cli import _reading
from isa_nrsfm.cli._main import show_stage
from isa_nrsfm.cli._options import DEFAULTS
from isa_nrsfm.cli._reading import Frames, as_numbers, cells_of, column_named
from isa_nrsfm.export import point_distances
from isa_nrsfm.export._upright import EYES, point_numbers
from isa_nrsfm.export._viewer import MOST_LABELS


def asked_columns(args: Namespace, frames: Frames) -> Frames:
    """Return the frames with labels, groups and times; raise if these cannot be used.

    The points of distances in the options become their numbers.
    """
    table, names = frames.other.loc[frames.X.index], frames.columns.points
    labels = [_label(table, text) for text in args.label]
    groups = None if args.group is None else _groups(table, args.group)
    times, unit = None, "seconds"
    if args.time_format is not None and args.time is None:
        raise ValueError("--time-format needs --time")
    if args.time is not None:
        with errors_of(f"--time {args.time}"):
            cells = cells_of(table, args.time, "--time")
            times, unit = _reading.read_times(cells, args.time_format)
    elif args.fps is not None:
        times = _reading.video_times(frames.images[table.index], groups) / args.fps
    if times is not None:
        try:
            seconds = _frame_columns.checked_times(times, len(table))
            numbers = _frame_columns.group_numbers(groups, len(table))
            _frame_columns.sequences_of(seconds, numbers, 1)
        except ValueError as error:
            hint = " (--group: the rows that belong together)" * (groups is None)
            option = "--fps" if args.time is None else f"--time {args.time}"
            raise ValueError(f"{option}: {error}{hint}") from error
    args.distance = [_numbered(pair, names, "--distance") for pair in args.distance]
    if args.unit is not None:
        args.unit = _numbered(args.unit, names, "--unit")
        if not args.distance and args.camera != "perspective":
            raise ValueError("--unit needs --distance, or --camera perspective")
    elif args.distance and len(names) != 68:
        raise ValueError(
            f"--distance needs --unit: the {len(names)} points are not the 68 of a "
            "face, whose outer corners of the eyes are the unit. Give two points, such "
            f"as --unit {names[0]},{names[1]}"
        )
    return frames._replace(labels=labels, groups=groups, times=times, time_unit=unit)


def column_results(
    args: Namespace, estimator: AffineNRSfM, frames: Frames
) -> tuple[dict[str, Any], dict[str, NDArray], Any]:
    """Return entries of the report, columns of alpha.csv and smoothed coefficients."""
    alpha, smooth = estimator.alpha_, None
    report: dict[str, Any] = {}
    columns: dict[str, NDArray] = {}
    if frames.labels:
        report["labels"] = [*_label_reports(args, estimator, frames)]
    if frames.groups is not None:
        report["groups"] = {"column": args.group}
        try:
            report["groups"] |= analysis.between_share(alpha, frames.groups)._asdict()
        except ValueError as error:  # one group, or groups of one frame
            report["groups"]["not_divided"] = str(error)
        within = analysis.WithinGroups().fit_transform(alpha, groups=frames.groups)
        columns |= {f"alpha_{k}_within": each for k, each in enumerate(within.T, 1)}
    if frames.times is not None and estimator.refinement in JOINT_REFINEMENTS:
        show_stage("smoothing")
        of_rows = {"groups": frames.groups} | frames.weighting
        smooth = estimator.smooth(frames.X, time=frames.times, **of_rows)
        found, images = smooth.alpha, frames.images[frames.X.index]
        report["time"] = {
            "column": args.time or images.name,
            "frames": None if args.time else [images.min(), images.max()],
            "unit": frames.time_unit,
            "time_scales": smooth.time_scales,
            "changed_by": np.sqrt(np.nanmean((found - alpha) ** 2)),
        }
        columns |= {f"alpha_{k}_smooth": each for k, each in enumerate(found.T, 1)}
    has_positions = hasattr(estimator, "positions_")
    has_unit = args.unit is not None or args.length != DEFAULTS["length"]
    if args.distance or (has_positions and has_unit):
        names = [f"distance_{a}_{b}" for a, b in args.distance]
        ends = args.unit or EYES  # of the unit of positions as well
        try:
            length = {"unit": args.unit, "length": args.length}
            found = point_distances(estimator, [*args.distance, ends], **length)
            columns |= zip(names, found.T[:-1], strict=True)
            if has_positions:
                size = np.linalg.norm(np.subtract(*estimator.mean_shape_[[*ends]]))
                report["position_unit"] = {
                    "points": ends,
                    "length": args.length,
                    "per_unit_of_shapes": args.length / size,
                }
        except ValueError as error:
            what = "alpha.csv has no distances" if names else "--length has no effect"
            warn_caller(f"{what}: {error}")
    return report, columns, smooth


def has_classes(label: "pd.Series", most: float = np.inf) -> bool:
    """Return whether a label has classes, and at most so many."""
    classes = isinstance(label.dtype, pd.CategoricalDtype)
    return classes and len(label.cat.categories) <= most


def class_means(label: "pd.Series", alpha: NDArray) -> dict[str, NDArray]:
    """Return the mean of the standardised coefficients in each class."""
    deviation = alpha.std(axis=0)
    standard = (alpha - alpha.mean(axis=0)) / np.where(deviation > 0, deviation, np.inf)
    return {str(c): standard[label == c].mean(axis=0) for c in label.cat.categories}


def first_classes(labels: "Sequence[pd.Series]") -> "pd.Series | None":
    """Return the first label of few classes, which colours the frames in the viewer."""
    few = [label for label in labels if has_classes(label, MOST_LABELS)]
    return few[0].map(str, na_action="ignore").astype(object) if few else None


def _numbered(
    pair: tuple[str, str], names: Sequence[str], option: str
) -> tuple[int, int]:
    """Return the numbers of two points."""
    with errors_of(f"{option} {','.join(pair)}"):
        return point_numbers(pair, names)


def _label(table: "pd.DataFrame", text: str) -> "pd.Series":
    """Return the label of COLUMN, COLUMN:classes or COLUMN:number."""
    name, colon, kind = text.rpartition(":")
    if not colon or kind not in ("classes", "number"):
        name, kind = text, "auto"
    names = _names(cells_of(table, name, "--label").dropna())
    if names.empty:
        raise ValueError(f"--label: no frame has a {name!r}")
    numbers = names if kind == "classes" else as_numbers(names)
    if kind == "auto" and numbers.notna().all() and (numbers % 1 != 0).any():
        kind = "number"
    if kind == "number" and numbers.isna().any():
        row = numbers.isna().idxmax()
        wrong = f"got {names[row]!r} in row {row}"
        raise ValueError(f"--label {text}: labels must be numbers; {wrong}")
    values = (numbers if kind == "number" else names).to_numpy()
    if values.dtype.kind not in "biuf":
        values = values.astype(str)
    _frame_columns.refuse_infinite(f"--label {text}", values, names.index.to_numpy())
    with errors_of(f"--label {text}"):
        kind = _frame_columns.kind_of(values, kind)
    dtype = "category" if kind == "classes" else None
    return pd.Series(values, names.index, dtype, name).reindex(table.index)


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
    from sklearn.decomposition import PCA  # not needed without labels

    table = np.where(X.isna(), estimator.reproject(X), X)
    aligned = analysis.AlignedFrames().fit_transform(table)
    n_shapes = len(estimator.basis_)
    n_scores = min(3 * n_shapes + 3, *aligned.shape)
    scores = PCA(n_scores, random_state=0).fit_transform(aligned)
    key = "cross_validated_pca"
    return {key: scores[:, :n_shapes], f"{key}_of_rank": scores}


def _label_reports(
    args: Namespace, estimator: AffineNRSfM, frames: Frames
) -> Iterator[dict[str, Any]]:
    """Yield the association of coefficients with each label."""
    alpha = estimator.alpha_
    of_frames = frames.groups, frames.times, getattr(estimator, "alpha_std_", None)
    features = {"cross_validated": alpha} | _aligned_pca(estimator, frames.X)
    for label in frames.labels:
        labelled, classes = label.notna().to_numpy(), has_classes(label)
        groups, time, std = (x if x is None else x[labelled] for x in of_frames)
        options: dict[str, Any] = {"groups": groups, "time": time}
        options |= {"y": label.dropna().to_numpy(), "random_state": args.random_state}
        options["kind"] = "classes" if classes else "number"
        found = analysis.association(alpha[labelled], alpha_std=std, **options)
        report: dict[str, Any] = {
            "column": label.name,
            "kind": found.kind,
            "n_frames": found.n_frames,
            "n_without_label": np.sum(~labelled),
            "n_copies": np.sum(labelled) - found.n_frames,
            "statistic": "eta_squared" if classes else "spearman",
            "values": found.statistic,
            "corrected": found.corrected,
            "p_values": found.p_value,
            "permuted": found.permuted,
            "untested": found.untested,
            "score": "accuracy" if classes else "r_squared",
        }
        if classes:
            counts = label.value_counts(sort=False)
            report["classes"] = counts.rename(str).to_dict()
            report["largest_class"] = counts.max() / counts.sum()
            report["class_means"] = class_means(label, alpha)
        try:
            for key, values in features.items():
                scores = analysis.predictability(values[labelled], **options)
                report[key], n = scores.mean(), len(scores)
                report[f"{key}_standard_error"] = scores.std(ddof=1) / np.sqrt(n)
                report[f"{key}_n_features"] = values.shape[1]
        except ValueError as error:  # too few frames, or groups, for two folds
            report["not_cross_validated"] = str(error)
        yield report
