"""The commands fit, and demo: fit artificial faces, and compare with the truth."""

import contextlib
import re
import shlex
import sys
import warnings
from argparse import Namespace
from datetime import UTC, datetime
from pathlib import Path
from platform import python_version
from typing import Any

import numpy as np
from joblib import parallel_config
from sklearn.model_selection import GroupKFold

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, __version__, _parameters as choices
from isa_nrsfm._compat import files, pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._compat.texts import first_items
from isa_nrsfm._fitted_model import hold_open
from isa_nrsfm._prepare.coordinates import TOLD, still_points
from isa_nrsfm._selection import FIRST, Trial, decided, first_settings, standard_errors
from isa_nrsfm.analysis._diagnostics import Diagnostics
from isa_nrsfm.cli import _columns, _figures, _options, _reading, _report
from isa_nrsfm.cli._main import show_stage
from isa_nrsfm.cli._options import AUTO, FACE_PRIORS, NONE, flag_of
from isa_nrsfm.datasets import load_face_prior, make_face_tracks
from isa_nrsfm.io import load_model, write_table
from isa_nrsfm.io._landmark_columns import MIN_POINTS, LandmarkColumns, same_but_for
from isa_nrsfm.io._tables import TABLE_SUFFIXES
from isa_nrsfm.isa import FastISA, PooledFastICA
from isa_nrsfm.metrics import affine_shape_error
from isa_nrsfm.skeletons import _column_names

# Columns that are probably labels or groups come first: action units, emotions, people.
LABEL = re.compile(_column_names.WORDS["labels"], re.IGNORECASE)
# Parts of the table that are held out in turn: blocks of rows, because neighbours are
# often alike.
N_PARTS = 3
# Options that are parameters of the same name; none stands for None.
_PARAMETERS = "block_recovery focal_length independence random_state n_jobs".split()


def run_fit(args: Namespace, warned: list[str]) -> str:
    """Fit a table, write everything, and return the text of the report."""
    report, _ = fit_table(args, warned)
    return _report.text_of(_report.fit_title(report), report["summary"])


def fit_table(
    args: Namespace, warned: list[str], table: "pd.DataFrame | None" = None
) -> tuple[dict[str, Any], AffineNRSfM]:
    """Fit a table, write everything, and return the report and the model.

    A given table is written to the path in the options. `warned` has the warnings so
    far, and grows.
    """
    prior, folder, inputs = args.prior, Path(args.output), []
    _check_options(args)
    if prior not in (None, NONE, *FACE_PRIORS):
        args.prior = load_model(prior)
        inputs.append(prior)
    frames = _moving_points(args, _reading.read_frames(args, table=table), table)
    if prior in FACE_PRIORS:
        layout = _reading.face_layout(args, frames)
        if layout is None:
            raise ValueError(
                f"--prior {prior} has no points of this table, whose layout is not "
                f"one of {', '.join(choices.FACE_PRIORS)}. Name it with --skeleton, "
                "or give --prior the model.npz of a table in which the objects turn"
            )
        K = None if args.n_components in (None, (AUTO,)) else args.n_components[0]
        args.prior = load_face_prior(K, layout=layout)
    X = frames.X
    X.attrs[TOLD] = True
    if X.empty:
        out = [f"{e['n_rows']} left out ({e['reason']})" for e in frames.left_out]
        none = f"{args.table} has no row that can be fitted"
        raise ValueError(f"{none}: {', '.join(out)}")
    frames = _columns.asked_columns(args, frames)
    needs_centre = args.camera == "perspective" or args.focal_length is not None
    if needs_centre and frames.principal_point is None:
        option = "--focal-length" if args.focal_length else "--camera perspective"
        raise ValueError(
            f"{option} needs the size of the images, with --image-size "
            "WIDTHxHEIGHT such as 1280x720, or the point of the image on the axis of "
            "the camera, with --principal-point X Y (0 0 and --focal-length 1 for "
            "normalised coordinates)"
        )
    figures = {} if args.no_figures else _figures.figures_of(frames)
    drawn = _reading.drawing(args, frames.columns.points, frames.skeleton)
    results = dict.fromkeys(_report.RESULTS, "")
    if table is None:
        inputs.append(args.table)
    else:
        results[Path(args.table).name] = ""
    with files.folder_for_writing(folder):
        targets = [folder / name for name in (*results, *figures, _report.REPORT)]
        earlier = _report.entry_of_report(folder, "sha256")
        own_files = {*earlier, _report.REPORT} if earlier else ()
        _report.check_outputs(args, inputs, targets, own_files)
        for target in targets:
            files.check_replaceable(target)
        old = _report.entry_of_report(folder, "files")
        removed = {*figures, *(name for name in old if name.endswith(".png"))}
        labels = {label.name for label in frames.labels}
        used = {args.group, args.time, frames.images.name, *labels}
        unused = [name for name in frames.other if name and name not in used]
        unused.sort(key=lambda name: not LABEL.search(str(name)))
        estimator, trials, choice, diagnostics = _fitted(args, frames)
        show_stage("answers")
        answers, columns, smooth = _columns.column_results(args, estimator, frames)
        show_stage("tables")
        with files.files_together(folder, removed=removed) as new:
            if table is not None:
                write_table(table, new / Path(args.table).name)
            alpha, std = estimator.alpha_, estimator.alpha_std_ if args.std else None
            _report.write_alpha(new / "alpha.csv", frames, alpha, std, **columns)
            shown = _report.depth_std(args, estimator, X, frames.weighting)
            shown["labels"] = _columns.first_classes(frames.labels)
            unit = answers.get("position_unit", {}).get("per_unit_of_shapes", 1.0)
            explained = estimator.reproject(X, **frames.weighting)
            fit = _report.Fit(estimator, frames, smooth, drawn, explained)
            _report.write_results(new, fit, unit, times=frames.times, **shown)
            if (std := getattr(estimator, "prior_std_", None)) is not None:
                answers["prior"] = {"name": prior or _options.FACE_PRIOR, "std": std}
            report = {
                "command": "fit",
                "arguments": args.arguments,
                "finished": datetime.now(UTC).isoformat(timespec="seconds"),
                "table": _report.table_report(args, frames) | {"other_columns": unused},
                **choice,
                "model": _report.model_report(fit, diagnostics),
                "tried": [{**each._asdict(), "text": repr(each)} for each in trials],
                **answers,
                "warnings": warned,
                "versions": {"isa_nrsfm": __version__, "python": python_version()},
            }
            report |= {"files": results, "summary": _report.summary(report, folder)}
            report = _report.write_report(new, report)
        if not figures:
            return report, estimator
        # A figure that fails, or takes long, costs no results: they are in place.
        with files.files_together(folder) as new:
            if _report.digests_of(folder, report["sha256"]) != report["sha256"]:
                raise ValueError(
                    f"another run has written to {folder} in the meantime: the folder "
                    "has its files, and no figures of this run"
                )
            report["files"] = results | _figures.write_figures(new, figures, fit)
            report = _report.write_report(new, report)
    return report, estimator


def _moving_points(
    args: Namespace, frames: _reading.Frames, table: Any
) -> _reading.Frames:
    """Leave out points that stand still, unless the options name the points."""
    points = frames.columns.points
    if args.points is args.columns is frames.skeleton is None:
        _refuse_views(frames.columns)
    tracks = frames.X.to_numpy().reshape(len(frames.X), len(points), 2)
    still = still_points(tracks) if args.points is None else ()
    if not len(still):
        return frames
    names = [points[j] for j in still]
    args.points = f"without:{','.join(names)}"
    warn_caller(
        f"{len(names)} points stand still while the others move through the image, and "
        f"are left out: {first_items(names, 12)}. --points fits those that it names"
    )
    with warnings.catch_warnings(action="ignore"):  # of the first reading
        return _reading.read_frames(args, table=table)


def _refuse_views(columns: LandmarkColumns) -> None:
    """Raise if points have the names of several individuals, or of views of one."""
    points, x = columns.points, columns.x
    if who := _column_names.individuals_in(x, MIN_POINTS):
        own = _column_names.columns_of_individuals(x, who)[who[0]]
        some = [name for name, each in zip(points, x, strict=True) if each in own]
        raise ValueError(
            f"{same_but_for(who, len(points))}. Fit those of one with --points "
            f"{shlex.quote(','.join(some))}. If all are points of one body, use "
            f"--points 0-{len(points) - 1}"
        )


def _check_options(args: Namespace) -> None:
    """Raise before a long fit if options exclude each other or a library is absent."""
    suffixes = {*TABLE_SUFFIXES, *(Path(name).suffix for name in _report.RESULTS)}
    if Path(args.output).suffix.lower() in suffixes and not Path(args.output).is_dir():
        raise ValueError(
            f"--output {args.output}: expected a folder, because fit writes several "
            "files; the table of coefficients is alpha.csv in it"
        )
    if not args.no_figures:
        import_optional("matplotlib", extra="plot")
    given = {name: each for name, each in vars(args).items() if each is not None}
    given = {name: None if each == NONE else each for name, each in given.items()}
    auto = {"n_components": AUTO} if args.n_components == (AUTO,) else {}
    choices.check_requirements(given | auto | {"point_weight": args.weights})
    lens = args.focal_length or args.camera not in choices.CALIBRATED_CAMERAS
    if args.principal_point is not None and not lens:
        needed = f"--focal-length with --camera {args.camera}"
        raise ValueError(f"--principal-point needs {needed}")
    several = args.n_components is not None and len(args.n_components) > 1
    one = {"weights": "numbers are compared without weights"}
    one["prior"] = "a fit has those of the prior"
    for name, why in one.items():
        if several and getattr(args, name) not in (None, NONE):
            raise ValueError(
                f"{flag_of(name)} needs one number of basis shapes, because {why}; "
                "give it with --n-components, or auto"
            )


def _fitted(
    args: Namespace, frames: _reading.Frames
) -> tuple[AffineNRSfM, list[Trial], dict[str, Any], Diagnostics | None]:
    """Return the model that held-out points prefer, and what was tried.

    Also the report on its K and the diagnostics. Options that are given are kept.
    """
    isa: Any = FastISA() if args.isa == "fast" else None
    if args.n_init is not None:
        isa = (isa or PooledFastICA()).set_params(n_init=args.n_init)
    given = {name: getattr(args, name) for name in (*FIRST, *_PARAMETERS)}
    given = {name: v for name, v in given.items() if v not in (None, (AUTO,))}
    given = {name: None if v == NONE else v for name, v in given.items()}
    if "n_components" in given:
        given["n_components"] = args.n_components[0]
    params, free = first_settings(given)
    params["scale_frames"] = not args.no_scale_frames
    params["hidden_points"] = not args.no_hidden_points
    estimator = AffineNRSfM(isa=isa, remove_pose=args.remove_pose, **params)
    if estimator.camera == "perspective" or args.focal_length is not None:
        estimator.set_params(principal_point=frames.principal_point)
    choice: dict[str, Any] = {}
    X, groups, weights = frames.X, frames.groups, frames.weighting
    if args.n_components and len(args.n_components) > 1:
        show_stage("choice of the number of basis shapes")
        splitter: Any = N_PARTS
        if groups is not None:
            n_groups = len(np.unique(groups.astype(str)))
            if n_groups < 2:
                raise ValueError(
                    "--group: numbers of basis shapes are compared on held-out groups, "
                    f"which needs two groups; got {n_groups}"
                )
            splitter = GroupKFold(min(N_PARTS, n_groups))
        options = {"cv": splitter, "select": "one_standard_error", "verbose": 1}
        search = AffineNRSfMCV(args.n_components, estimator=estimator, **options)
        with contextlib.redirect_stdout(sys.stderr):  # results are printed at once
            search.fit(X, groups=groups)
        estimator, choice["choice"] = search.best_estimator_, choice_report(search)
    else:  # for `shown_progress`; the model that is written does not have it
        estimator.set_params(verbose=2)
    known: dict[str, Any] = {"groups": groups, **weights}
    known["principal_point"] = frames.principal_point
    known["face_layout"] = _reading.face_layout(args, frames)
    estimator, trials = decided(estimator, X, free, show=show_stage, **known)
    estimator.set_params(verbose=0)
    with parallel_config(n_jobs=2):  # threads for blocks of frames
        hold_open(estimator, X, **weights)
    joint = estimator.refinement in choices.JOINT_REFINEMENTS
    diagnostics = estimator.diagnostics(X, **weights) if joint else None
    return estimator, trials, choice, diagnostics


def choice_report(search: AffineNRSfMCV) -> dict[str, Any]:
    """Return the numbers tried, their held-out errors, and the one chosen."""
    results, parts = search.cv_results_, range(search.n_splits_)
    of_parts = -np.transpose([results[f"split{i}_test_score"] for i in parts])
    return {
        "n_components": results["param_n_components"].tolist(),
        "held_out_error": -results["mean_test_score"],
        "held_out_error_standard_error": standard_errors(of_parts),
        "held_out_error_of_parts": of_parts,
        "chosen": search.n_components_,
    }


def run_demo(args: Namespace, warned: list[str]) -> str:
    """Fit artificial faces, and compare the result with the truth."""
    faces = make_face_tracks(400, n_components=3, random_state=0)
    table = pd.DataFrame(faces.data.round(2), columns=faces.feature_names)
    table.insert(0, "frame", [f"face{i:03d}" for i in range(len(table))])
    folder = Path(args.output)
    options = ["fit", str(folder / "tracks.csv"), "--output", str(folder)]
    options += ["--force"] * args.force + ["--no-figures"] * args.no_figures
    options += _reading.drawing_options(args)
    started = Namespace(arguments=options, since=args.since)
    parsed = _options.build_parser().parse_args(options, started)
    report, model = fit_table(parsed, warned, table=table)
    shapes = model.shapes(model.alpha_)
    rigid = np.broadcast_to(model.mean_shape_, shapes.shape)
    error, alone = (affine_shape_error(faces.shapes, each) for each in (shapes, rigid))
    errors = f"{100 * error:.1f} % (the mean shape alone: {100 * alone:.1f} %)"
    truth = f"the 3D shapes of the frames are off by {errors}"
    again = shlex.join([_options.PROGRAM, *options])
    rows = [*report["summary"], ["truth", "", truth], ["again", "", again]]
    return _report.text_of(_report.fit_title(report), rows)
