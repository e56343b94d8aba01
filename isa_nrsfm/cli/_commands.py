"""The command fit, from options to the text of its report."""

import time
from argparse import Namespace
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA, PooledFastICA
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._compat.whole_files import files_together, folder_for_writing
from isa_nrsfm._tables.landmark_columns import find_landmark_columns
from isa_nrsfm.cli._answers import (
    answer_figures,
    answered,
    asked_for,
    draw_answers,
    first_classes,
)
from isa_nrsfm.cli._choice import choice_report, choose_n_components
from isa_nrsfm.cli._drawing import chosen_edges
from isa_nrsfm.cli._drawing_options import drawing_files
from isa_nrsfm.cli._frames import Frames
from isa_nrsfm.cli._outputs import (
    ARRAYS,
    CHOICE_FIGURE,
    FIGURES,
    MODEL,
    PAGE,
    TABLES,
    check_outputs,
    old_figures,
    write_figures,
    write_report,
    write_results,
)
from isa_nrsfm.cli._page import REPORT_PAGE, write_report_page
from isa_nrsfm.cli._parser import AUTO
from isa_nrsfm.cli._progress import show_stage
from isa_nrsfm.cli._reading import read_frames, taken_frames
from isa_nrsfm.cli._report import (
    fit_text,
    model_report,
    table_report,
    versions,
)
from isa_nrsfm.cli._runs import REPORT, is_of_run
from isa_nrsfm.io import write_table

if TYPE_CHECKING:
    import pandas as pd


def run_fit(args: Namespace, warned: list[str]) -> str:
    """Fit a table, write everything, and return the report."""
    return fit_text(fit_table(args, warned), Path(args.output))


def fit_table(
    args: Namespace,
    warned: list[str],
    *,
    table: "pd.DataFrame | None" = None,
    **extra: "Callable[[AffineNRSfM, pd.DataFrame], Any]",
) -> dict[str, Any]:
    """Fit a table and write everything; return the report.

    Parameters
    ----------
    args : Namespace
        The options of the command fit.
    warned : list of str
        The messages of the warnings shown so far. It grows while the fit runs.
    table : DataFrame, optional
        A table to fit instead of that of the options, which then says how the file is
        called that it is written to, with the results.
    **extra : callable
        Further entries of the report, computed from the model and its table.
    """
    # A library that is missing at the end of a long fit should be known before it.
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
    clock = {"": args.since}
    if table is None:
        frames = read_frames(args)
    else:
        args.format = "table"
        frames = taken_frames(args, table, find_landmark_columns(table.columns))
    X = frames.points[frames.usable]
    if X.empty:
        raise ValueError(f"no row of {args.table} is left to fit{_reasons(frames)}")
    asked = asked_for(args, frames)
    several = len(args.n_components) > 1
    figures = {}
    if not args.no_figures:
        choice = CHOICE_FIGURE if several else {}
        figures = FIGURES | choice | answer_figures(asked)
    about = {REPORT_PAGE: "this report with its figures, for any browser"}
    results = about | MODEL | TABLES | ARRAYS | PAGE
    edges = chosen_edges(args, frames.columns.points, frames.skeleton)
    drawn: dict[str, Any] = {"edges": edges, "origin": args.origin or "auto"}
    inputs = [args.table, *drawing_files(args)]
    if table is not None:
        results, inputs = results | {Path(args.table).name: "the table"}, inputs[1:]
    with folder_for_writing(folder):
        files = (*results, *figures, REPORT)
        check_outputs((folder / name for name in files), inputs)
        removed = {*old_figures(folder, files), *figures}
        clock["read"] = time.perf_counter()
        estimator, search = _fitted(args, X, asked.groups, clock)
        show_stage("answers")
        answers = answered(asked, estimator, X, args.random_state)
        show_stage("tables")
        with files_together(folder, removed=removed) as new:
            if table is not None:
                write_table(table, new / Path(args.table).name)
            write_results(
                new,
                estimator,
                frames,
                answers.alpha,
                std=args.std,
                labels=first_classes(asked, X),
                times=asked.times,
                **drawn,
            )
            model = model_report(estimator, X, frames, edges)
            report = {
                "command": "fit",
                "arguments": args.arguments,
                "finished": datetime.now(UTC).isoformat(timespec="seconds"),
                "table": table_report(args.table, args.format, frames),
                **({} if search is None else {"choice": choice_report(search, X)}),
                "model": model,
                **answers.report,
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
                    f"another run has written to {folder} meanwhile; its files are "
                    "there, and no figures of this one"
                )
            write_figures(new, estimator, X, args.random_state, search, **drawn)
            draw_answers(new, asked, answers, estimator, **drawn)
            there = {name: figures[name] for name in figures if (new / name).exists()}
            report = _written(new, report, results | there, clock, "figures")
    return report


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
    write_report_page(folder, report)
    return write_report(folder, report)


def _fitted(
    args: Namespace,
    X: "pd.DataFrame",
    groups: "NDArray | None",
    clock: dict[str, float],
) -> tuple[AffineNRSfM, AffineNRSfMCV | None]:
    """Return the model that the options ask for, and the search for its K."""
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


def _strategy(args: Namespace) -> Any:
    """Return the independent subspace analysis that the options ask for."""
    if args.n_init is None:
        return None if args.isa == "pooled" else FastISA()
    kind = PooledFastICA if args.isa == "pooled" else FastISA
    return kind(n_init=args.n_init)


def _reasons(frames: Frames) -> str:
    """Say which rows were left out, for a message."""
    counts = [f"{len(out.rows)} left out ({out.reason})" for out in frames.left_out]
    return f": {', '.join(counts)}" if counts else ""
