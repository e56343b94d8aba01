"""The commands fit and transform, from options to the text of their report."""

import contextlib
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM, Decomposition, FastISA, PooledFastICA
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._tables.landmark_columns import (
    LandmarkColumns,
    find_landmark_columns,
    parse_coordinate,
    point_names,
)
from isa_nrsfm.cli._choice import choice_report, choose_n_components
from isa_nrsfm.cli._frames import Frames, choose_frames
from isa_nrsfm.cli._outputs import (
    alpha_table,
    beside_other_columns,
    prepare_folder,
    refuse_overwriting,
    write_figures,
    write_report,
    write_results,
)
from isa_nrsfm.cli._parser import AUTO
from isa_nrsfm.cli._report import (
    fit_text,
    lay_out,
    model_report,
    quality_lines,
    quality_report,
    table_lines,
    table_report,
    versions,
)
from isa_nrsfm.io import (
    FORMATS,
    find_format,
    load_model,
    read_landmarks,
    read_table,
    write_table,
)
from isa_nrsfm.io._tables import table_suffix

if TYPE_CHECKING:
    import pandas as pd

# Points and coordinates in the order of the columns.
_SHAPES = {"interleaved": (-1, 2), "planar": (2, -1)}


def run_fit(args: Namespace, warned: list[str]) -> str:
    """Fit a table, write everything, and return the report."""
    return fit_text(fit_table(args, warned), Path(args.output))


def fit_table(
    args: Namespace,
    warned: list[str],
    **extra: "Callable[[AffineNRSfM, pd.DataFrame], Any]",
) -> dict[str, Any]:
    """Fit a table and write everything; return the report.

    Parameters
    ----------
    args : Namespace
        The options of the command fit.
    warned : list of str
        The messages of the warnings shown so far. It grows while the fit runs.
    **extra : callable
        Further entries of the report, computed from the model and its table.
    """
    # What is missing at the end of a long fit should be known before it.
    import_optional("skops.io", extra="share")
    if not args.no_figures:
        import_optional("matplotlib", extra="plot")
    if args.std and args.refinement != "joint":
        raise ValueError(
            "--std: only --refinement joint knows the standard deviations of the "
            f"coefficients; got --refinement {args.refinement}"
        )
    if args.n_components[0] == AUTO and args.refinement != "joint":
        raise ValueError(
            "--n-components auto needs --refinement joint; got --refinement "
            f"{args.refinement}"
        )
    folder = Path(args.output)
    clock = {"": time.perf_counter()}
    frames = read_frames(args)
    X = frames.points[frames.usable]
    if X.empty:
        raise ValueError(f"no row of {args.table} is left to fit{_reasons(frames)}")
    several = len(args.n_components) > 1
    files = prepare_folder(
        folder, [args.table], figures=not args.no_figures, choice=several
    )
    clock["read"] = time.perf_counter()

    estimator = AffineNRSfM(
        args.n_components[0],
        isa=_strategy(args),
        block_recovery=args.block_recovery,
        refinement=None if args.refinement == "none" else args.refinement,
        camera=args.camera,
        independence=None if args.independence == "none" else args.independence,
        loss=args.loss,
        scale_frames=not args.no_scale_frames,
        random_state=args.random_state,
        n_jobs=args.n_jobs,
    )
    search = None
    if several:
        search = choose_n_components(estimator, X, args.n_components)
        estimator = search.best_estimator_
        clock["choose"] = time.perf_counter() - search.refit_time_
    else:
        with _progress(estimator):
            estimator.fit(X)
    if estimator.refinement == "joint":
        estimator.diagnostics()  # for its warnings
    clock["fit"] = time.perf_counter()

    write_results(folder, estimator, frames, std=args.std)
    if not args.no_figures:
        write_figures(folder, estimator, X, args.random_state, search)
    model = model_report(estimator, X, frames)
    clock["write"] = time.perf_counter()
    report = {
        "command": "fit",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "table": table_report(args.table, args.format, frames),
        **({} if search is None else {"choice": choice_report(search, X)}),
        "model": model,
        **{name: compute(estimator, X) for name, compute in extra.items()},
        "seconds": dict(
            zip([*clock][1:], np.diff([*clock.values()]).round(3), strict=True)
        ),
        "warnings": warned,
        "versions": versions(),
        "files": files,
    }
    write_report(folder, report)
    return report


def run_transform(args: Namespace, warned: list[str]) -> str:
    """Write the coefficients of a table's rows, and return the report."""
    output = Path(args.output)
    table_suffix(output)
    estimator = load_model(args.model)
    if args.std and not hasattr(estimator, "alpha_std_"):
        raise ValueError(
            f"--std: {args.model} was fitted with refinement="
            f"{estimator.refinement!r}, which does not know the standard deviations "
            "of its coefficients"
        )
    frames = read_frames(args, estimator)
    for source in (args.table, args.model):
        refuse_overwriting(source, [output])
    X = as_fitted(estimator, frames.points[frames.usable])
    n_frames, n_components = len(X), len(estimator.basis_)
    none = np.empty((0, n_components))
    fit = Decomposition(np.empty((0, 2, 3)), np.empty((0, 2)), none, none)
    quality = ["no frame was fitted"]
    if n_frames:
        fit = estimator.decompose(X)
        quality = quality_lines(quality_report(estimator, X, fit))
    results = alpha_table(fit, frames, std=args.std)
    write_table(beside_other_columns(results, frames.other), output)

    table = table_report(args.table, args.format, frames)
    title = f"{n_components} coefficients of {n_frames} frames"
    sections = {
        "Table": table_lines(table, unusable="without coefficients"),
        "Model": [args.model],
        "Quality": quality,
        "Output": [str(output), f"{len(results)} rows"],
    }
    return f"{title}\n\n{lay_out(sections)}"


def read_frames(args: Namespace, estimator: AffineNRSfM | None = None) -> Frames:
    """Read the table and take its frames, for a model those with its points."""
    args.format = _format(args)
    table, chosen, failed = _read(args)
    if estimator is not None:
        columns = _columns_of_model(estimator, table, chosen)
    else:
        columns = chosen or find_landmark_columns(table.columns)
    frames = choose_frames(
        table,
        columns,
        rules=args.skip_rows,
        zeros_missing=args.zeros_missing,
        failed=failed,
    )
    # A format says itself which of its columns are landmarks.
    return frames if failed is None else frames._replace(not_used={})


def _format(args: Namespace) -> str:
    """Return the format of the table, and refuse options of another one."""
    found = args.format
    if found == "auto":
        found = "table" if args.columns is not None else find_format(args.table)
    if args.columns is not None and found != "table":
        raise ValueError(f"--columns is for --format table; got --format {found}")
    if args.image_size is not None and "image_size" not in FORMATS[found].options:
        raise ValueError(
            f"--image-size is for --format mediapipe; {args.table} is of format {found}"
        )
    if args.min_confidence is not None and found == "table":
        raise ValueError(
            f"--min-confidence: {args.table} is of format table, which has no "
            "confidences"
        )
    return found


def _read(
    args: Namespace,
) -> "tuple[pd.DataFrame, LandmarkColumns | None, NDArray[np.bool_] | None]":
    """Return the table, its landmark columns and its failed rows, where known."""
    if args.format == "table":
        table = read_table(args.table)
        if args.columns is None:
            return table, None, None
        return table, find_landmark_columns(table.columns, args.columns), None
    pd = import_optional("pandas", extra="io")
    options = {} if args.image_size is None else {"image_size": args.image_size}
    found = read_landmarks(
        args.table, args.format, min_confidence=args.min_confidence, **options
    )
    table = pd.concat([found.frames, found.points], axis=1)
    names = tuple(found.points)
    columns = LandmarkColumns(
        pattern=f"those of {args.format}",
        points=found.point_names,
        x=names[::2],
        y=names[1::2],
        z=(),
        gaps=(),
    )
    return table, columns, found.failed


def _columns_of_model(
    estimator: AffineNRSfM, table: "pd.DataFrame", chosen: LandmarkColumns | None
) -> LandmarkColumns:
    """Return the columns of the points that a model was fitted to.

    ``chosen`` are the landmarks of the table where more than their names tells them.
    """
    fitted = getattr(estimator, "feature_names_in_", None)
    n_points = len(estimator.mean_shape_)
    if fitted is None:
        found = chosen or find_landmark_columns(table.columns)
        if len(found.points) != n_points:
            raise ValueError(
                f"the model has {n_points} points, the table has {len(found.points)} "
                f"({found.pattern})"
            )
        return found
    tracks = np.array([str(name).strip() for name in fitted]).reshape(
        _SHAPES[estimator.layout]
    )
    x, y = tracks if estimator.layout == "planar" else tracks.T
    wanted = {*x, *y}
    in_table = {str(name).strip(): name for name in table.columns}
    # Columns that are coordinates or, where there are such, the chosen ones.
    candidates = (
        [name for name in table.columns if parse_coordinate(name) is not None]
        if chosen is None
        else chosen.interleaved
    )
    coordinates = {str(name).strip(): name for name in candidates}
    present = in_table if chosen is None else coordinates
    absent = [name for point in zip(x, y, strict=True) for name in point]
    absent = [name for name in absent if name not in present]
    surplus = [name for name in coordinates if name not in wanted]
    if absent or (surplus and chosen is not None):
        differences = [
            f"{len(names)} columns are only in the {where} ({_shortened(names)})"
            for names, where in ((absent, "model"), (surplus, "table"))
            if names
        ]
        raise ValueError(
            "the points of the table are not those of the model: "
            + "; ".join(differences)
        )
    return LandmarkColumns(
        pattern="those of the model",
        points=point_names(x),
        x=tuple(in_table[name] for name in x),
        y=tuple(in_table[name] for name in y),
        z=(),
        gaps=(),
    )


def as_fitted(estimator: AffineNRSfM, points: "pd.DataFrame") -> Any:
    """Return a table of landmarks with the columns that the model was fitted to."""
    fitted = getattr(estimator, "feature_names_in_", None)
    if fitted is None:
        x_then_y = points.to_numpy().reshape(len(points), -1, 2).swapaxes(1, 2)
        planar = estimator.layout == "planar"
        return x_then_y.reshape(points.shape) if planar else points.to_numpy()
    in_order = points[[str(name).strip() for name in fitted]]
    return in_order.set_axis(list(fitted), axis=1)


def _strategy(args: Namespace) -> Any:
    """Return the independent subspace analysis that the options ask for."""
    if args.n_init is None:
        return None if args.isa == "pooled" else FastISA()
    kind = PooledFastICA if args.isa == "pooled" else FastISA
    return kind(n_init=args.n_init)


@contextlib.contextmanager
def _progress(estimator: AffineNRSfM) -> Iterator[None]:
    """Show the progress of a fit on the terminal, if there is one."""
    if not sys.stderr.isatty():
        yield
        return
    estimator.set_params(verbose=1)
    with contextlib.redirect_stdout(sys.stderr):
        yield
    estimator.set_params(verbose=0)


def _reasons(frames: Frames) -> str:
    """Say which rows were left out, for a message."""
    counts = [f"{len(out.rows)} left out ({out.reason})" for out in frames.left_out]
    return f": {', '.join(counts)}" if counts else ""


def _shortened(names: list[str]) -> str:
    """List the first names."""
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
