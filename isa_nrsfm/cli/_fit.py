"""The command fit."""

import time
from argparse import Namespace
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA, PooledFastICA
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._compat.whole_files import (
    check_replaceable,
    files_together,
    folder_for_writing,
)
from isa_nrsfm.cli._choice import choice_report, choose_n_components
from isa_nrsfm.cli._columns import Columns, asked_columns, column_results
from isa_nrsfm.cli._drawing import chosen_edges, drawing_files
from isa_nrsfm.cli._figures import ALWAYS, Fit, figures_of, write_figures
from isa_nrsfm.cli._options import AUTO, NONE
from isa_nrsfm.cli._outputs import (
    RESULTS,
    refuse_overwriting,
    write_report,
    write_results,
)
from isa_nrsfm.cli._progress import show_stage
from isa_nrsfm.cli._reading import read_frames, take_frames
from isa_nrsfm.cli._report import model_report, table_report, versions
from isa_nrsfm.cli._runs import REPORT, files_of_report, is_of_run
from isa_nrsfm.cli._sections import fit_text, write_page
from isa_nrsfm.export._viewer import MOST_LABELS
from isa_nrsfm.io import write_table
from isa_nrsfm.io._landmark_columns import find_landmark_columns

if TYPE_CHECKING:
    import pandas as pd


def run(args: Namespace, warned: list[str]) -> str:
    """Fit a table, write everything, and return the text of the report."""
    return fit_text(fit_table(args, warned), Path(args.output))


def fit_table(
    args: Namespace,
    warned: list[str],
    *,
    table: "pd.DataFrame | None" = None,
    **extra: "Callable[[AffineNRSfM, pd.DataFrame], Any]",
) -> dict[str, Any]:
    """Fit a table, write everything, and return the report.

    A given table is written to the path in the options. `warned` has the warnings so
    far, and grows. Functions of the model and its table make `extra` entries of the
    report.
    """
    _check_options(args)
    folder = Path(args.output)
    clock = {"": args.since}
    results, inputs = RESULTS, [args.table, *drawing_files(args)]
    if table is None:
        frames = read_frames(args)
    else:
        args.format = "table"
        frames = take_frames(args, table, find_landmark_columns(table.columns))
        results, inputs = results | {Path(args.table).name: "the table"}, inputs[1:]
    X = frames.X
    if X.empty:
        out = ", ".join(
            f"{len(rows)} left out ({reason})" for reason, rows, _ in frames.left_out
        )
        raise ValueError(f"{args.table} has no row that can be fitted: {out}")
    asked = asked_columns(args, frames)
    figures = {} if args.no_figures else figures_of(args, asked)
    edges = chosen_edges(args, frames.columns.points, frames.skeleton)
    drawn: dict[str, Any] = {"edges": edges, "origin": args.origin or "auto"}
    with folder_for_writing(folder):
        files = [*results, *figures, REPORT]
        refuse_overwriting(inputs, [folder / name for name in files])
        for name in files:
            check_replaceable(folder / name)
        removed = {*_old_figures(folder, files), *figures}
        clock["read"] = time.perf_counter()
        estimator, search = _fitted(args, X, asked.groups, clock)
        show_stage("answers")
        answers, columns, smooth = column_results(args, asked, estimator, X)
        show_stage("tables")
        with files_together(folder, removed=removed) as new:
            if table is not None:
                write_table(table, new / Path(args.table).name)
            write_results(
                new,
                estimator,
                frames,
                columns,
                std=args.std,
                drawn=drawn,
                labels=_first_classes(asked, X),
                times=asked.times,
            )
            report = {
                "command": "fit",
                "arguments": args.arguments,
                "finished": datetime.now(UTC).isoformat(timespec="seconds"),
                "table": table_report(args.table, args.format, frames),
                **({} if search is None else {"choice": choice_report(search, X)}),
                "model": model_report(estimator, X, frames, edges),
                **answers,
                **{name: compute(estimator, X) for name, compute in extra.items()},
                "warnings": warned,
                "versions": versions(),
            }
            report = _written(new, report, results, clock, "write")
        if not figures:
            return report
        # A figure that fails, or takes long, costs no results: they are in place.
        with files_together(folder) as new:
            if not is_of_run(folder, report):
                raise ValueError(
                    f"another run has written to {folder} in the meantime: the folder "
                    "has its files, and no figures of this run"
                )
            fit = Fit(estimator, X, search, smooth, drawn)
            captions = write_figures(new, figures, fit)
            report = _written(new, report, results | captions, clock, "figures")
    return report


def _check_options(args: Namespace) -> None:
    """Raise before a long fit if options exclude each other or a library is absent."""
    if not args.no_figures:
        import_optional("matplotlib", extra="plot")
    if args.refinement == "joint":
        return
    got = f"needs --refinement joint; got --refinement {args.refinement}"
    if args.std:
        raise ValueError(f"--std {got}")
    if args.n_components[0] == AUTO:
        raise ValueError(f"--n-components auto {got}")


def _written(
    folder: Path,
    report: dict[str, Any],
    files: dict[str, str],
    clock: dict[str, float],
    stage: str,
) -> dict[str, Any]:
    """Write a report, with the seconds up to now, and return it."""
    clock[stage] = time.perf_counter()
    of_stages = np.diff([*clock.values()]).round(3)
    seconds = dict(zip([*clock][1:], of_stages, strict=True))
    report = report | {"seconds": seconds, "files": files}
    write_page(folder, report)
    return write_report(folder, report)


def _fitted(
    args: Namespace,
    X: "pd.DataFrame",
    groups: NDArray | None,
    clock: dict[str, float],
) -> tuple[AffineNRSfM, AffineNRSfMCV | None]:
    """Return the model that the options ask for, and the search for its K."""
    strategy = {"pooled": PooledFastICA, "fast": FastISA}[args.isa]
    options = {} if args.n_init is None else {"n_init": args.n_init}
    default = args.isa == "pooled" and args.n_init is None
    estimator = AffineNRSfM(
        args.n_components[0],
        isa=None if default else strategy(**options),
        block_recovery=args.block_recovery,
        refinement=None if args.refinement == NONE else args.refinement,
        camera=args.camera,
        independence=None if args.independence == NONE else args.independence,
        loss=args.loss,
        scale_frames=not args.no_scale_frames,
        random_state=args.random_state,
        n_jobs=args.n_jobs,
    )
    search = None
    if len(args.n_components) > 1:
        show_stage("choice of the number of basis shapes")
        search = choose_n_components(estimator, X, args.n_components, groups)
        estimator = search.best_estimator_
        clock["choose"] = time.perf_counter() - search.refit_time_
    else:
        # For `shown_progress`; the model that is written does not have it.
        estimator.set_params(verbose=2).fit(X)
        estimator.set_params(verbose=0)
    clock["fit"] = time.perf_counter()
    return estimator, search


def _old_figures(folder: Path, new: list[str]) -> list[str]:
    """Return the figures that the report of an earlier run lists; warn of others."""
    old = [name for name in files_of_report(folder) if name.endswith(".png")]
    others = sorted({*ALWAYS} - {*old, *new})
    others = [name for name in others if (folder / name).exists()]
    if others:
        warn_caller(f"{folder} has figures of an earlier run: {', '.join(others)}")
    return old


def _first_classes(asked: Columns, X: "pd.DataFrame") -> "pd.Series | None":
    """Return the first label of few classes, which colours the frames in the viewer."""
    pd = import_optional("pandas", extra="io")
    for label in asked.labels:
        if label.is_of_classes(MOST_LABELS):
            values = pd.Series(None, index=X.index, dtype=object, name=label.name)
            values[label.known] = [str(value) for value in label.values]
            return values
    return None
