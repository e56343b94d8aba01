"""The command fit."""

import contextlib
import sys
import time
import warnings
from argparse import Namespace
from datetime import UTC, datetime
from pathlib import Path
from platform import python_version
from typing import Any

import numpy as np
from joblib import parallel_config
from sklearn.base import clone
from sklearn.model_selection import GroupKFold

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA, PooledFastICA, __version__
from isa_nrsfm._compat import pandas as pd, whole_files
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._fitted_model import frames_of
from isa_nrsfm._parameters.choices import FACE_PRIORS as LAYOUTS, JOINT_REFINEMENTS
from isa_nrsfm._prepare.checks import most_components
from isa_nrsfm._prepare.coordinates import TOLD
from isa_nrsfm._selection import standard_errors
from isa_nrsfm.analysis._advice import facts_of
from isa_nrsfm.analysis._diagnostics import Diagnostics
from isa_nrsfm.cli import _outputs
from isa_nrsfm.cli._columns import asked_columns, column_results, first_classes
from isa_nrsfm.cli._figures import figures_of, write_figures
from isa_nrsfm.cli._options import AUTO, FACE_PRIOR, FACE_PRIORS, NONE, flag_of
from isa_nrsfm.cli._outputs import Fit
from isa_nrsfm.cli._progress import show_stage
from isa_nrsfm.cli._reading import (
    Frames,
    drawing,
    drawing_files,
    face_layout,
    read_frames,
)
from isa_nrsfm.cli._report import model_report, perspective_report, table_report
from isa_nrsfm.cli._sections import fit_text, write_report
from isa_nrsfm.datasets import load_face_prior
from isa_nrsfm.io import load_model, write_table
from isa_nrsfm.io._tables import TABLE_SUFFIXES
from isa_nrsfm.metrics._reprojection import frame_energies

# Parts of the table that are held out in turn: blocks of rows, because neighbours are
# often alike.
N_PARTS = 3
# Components of the face prior of tables that do not determine depths by themselves:
# docs/depth.md has figures of nine and of forty.
FACE_COMPONENTS = 9
# Options that are parameters of the same name; none stands for None.
_PARAMETERS = (
    *("block_recovery", "refinement", "camera", "focal_length", "independence"),
    *("prior", "loss", "random_state", "n_jobs"),
)


def run(args: Namespace, warned: list[str]) -> str:
    """Fit a table, write everything, and return the text of the report."""
    return fit_text(fit_table(args, warned)[0], Path(args.output), {})


def fit_table(
    args: Namespace, warned: list[str], table: "pd.DataFrame | None" = None
) -> tuple[dict[str, Any], AffineNRSfM]:
    """Fit a table, write everything, and return the report and the model.

    A given table is written to the path in the options. `warned` has the warnings so
    far, and grows.
    """
    prior = args.prior
    _load_prior(args)
    _check_options(args)
    folder, clock = Path(args.output), {"": args.since}
    frames = read_frames(args, table=table)
    if prior in FACE_PRIORS:
        layout = face_layout(args, frames)
        if layout is None:
            raise ValueError(
                f"--prior {prior} has no points of this table, whose layout is "
                f"not one of {', '.join(LAYOUTS)}. Name it with --skeleton, "
                "or give --prior the model.npz of a table in which the objects turn"
            )
        args.prior = load_face_prior(len(args.prior.basis_), layout=layout)
    frames.points.attrs[TOLD] = True
    X = frames.X
    if X.empty:
        out = ", ".join(f"{len(i)} left out ({why})" for why, i, _ in frames.left_out)
        raise ValueError(f"{args.table} has no row that can be fitted: {out}")
    frames = asked_columns(args, frames)
    if args.camera == "perspective" and frames.principal_point is None:
        raise ValueError(
            "--camera perspective needs the size of the images, with --image-size "
            "WIDTHxHEIGHT such as 1280x720, or the point of the image on the axis of "
            "the camera, with --principal-point X Y (0 0 and --focal-length 1 for "
            "normalised coordinates)"
        )
    figures = {} if args.no_figures else figures_of(args, frames)
    drawn = drawing(args, frames.columns.points, frames.skeleton)
    results, inputs = _outputs.RESULTS, drawing_files(args)
    if table is None:
        inputs.append(args.table)
    else:
        results = results | {Path(args.table).name: "the table"}
    if prior not in (None, NONE, *FACE_PRIORS):
        inputs.append(prior)
    with whole_files.folder_for_writing(folder):
        files = [*results, *figures, _outputs.REPORT]
        _outputs.refuse_overwriting(inputs, [folder / name for name in files])
        for name in files:
            whole_files.check_replaceable(folder / name)
        if not args.force:
            earlier = _outputs.entry_of_report(folder, "sha256")
            own = {*earlier, _outputs.REPORT} if earlier else ()
            _outputs.refuse_replacing([folder / name for name in files], own)
        old = _outputs.entry_of_report(folder, "files")
        removed = {*figures, *(name for name in old if name.endswith(".png"))}
        used = {args.group, args.time, frames.images.name}
        used |= {label.name for label in frames.labels}
        unused = [name for name in frames.other if name and name not in used]
        clock["read"] = time.perf_counter()
        estimator, search, diagnostics, perspective = _fitted(args, frames, clock)
        show_stage("answers")
        answers, columns, smooth = column_results(args, estimator, frames)
        show_stage("tables")
        together = whole_files.files_together(folder, removed=removed)
        with together as new, parallel_config(n_jobs=2):  # threads for blocks of frames
            if table is not None:
                write_table(table, new / Path(args.table).name)
            alpha, std = estimator.alpha_, estimator.alpha_std_ if args.std else None
            _outputs.write_alpha(new / "alpha.csv", frames, alpha, std, columns)
            shown = {"labels": first_classes(frames.labels), "times": frames.times}
            if args.std and estimator.camera_ != "affine":
                shown["depth_std"] = estimator.reconstruct(
                    X, return_std=True, **frames.weighting
                )[1]
            unit = answers.get("position_unit", {}).get("per_unit_of_shapes", 1.0)
            explained = estimator.reproject(X, **frames.weighting)
            energy, error, _ = frame_energies(X, explained, estimator.layout)
            snr = error / energy
            choice = None if search is None else choice_report(search, X)
            fit = Fit(estimator, frames, choice, smooth, drawn, explained, snr)
            _outputs.write_results(new, fit, unit, **shown)
            if (std := getattr(estimator, "prior_std_", None)) is not None:
                answers["prior"] = {"name": prior or FACE_PRIOR, "std": std}
            report = {
                "command": "fit",
                "arguments": args.arguments,
                "finished": datetime.now(UTC).isoformat(timespec="seconds"),
                "table": table_report(args, frames) | {"other_columns": unused},
                **({} if choice is None else {"choice": choice}),
                "model": model_report(fit, diagnostics, perspective),
                **answers,
                "warnings": warned,
                "versions": {"isa_nrsfm": __version__, "python": python_version()},
            }
            clock["write"] = time.perf_counter()
            report |= {"seconds": _seconds(clock), "files": results}
            report = write_report(new, report)
        if not figures:
            return report, estimator
        # A figure that fails, or takes long, costs no results: they are in place.
        with whole_files.files_together(folder) as new:
            if _outputs.digests_of(folder, report["sha256"]) != report["sha256"]:
                raise ValueError(
                    f"another run has written to {folder} in the meantime: the folder "
                    "has its files, and no figures of this run"
                )
            captions = write_figures(new, figures, fit)
            clock["figures"] = time.perf_counter()
            report |= {"seconds": _seconds(clock), "files": results | captions}
            report = write_report(new, report)
    return report, estimator


def _load_prior(args: Namespace) -> None:
    """Load the prior, and set the options that it determines unless they are given."""
    n_components, auto = 3, args.n_components in (None, (AUTO,))
    args.face_components = FACE_COMPONENTS if auto else args.n_components[0]
    if args.prior not in (None, NONE):
        face, K = args.prior in FACE_PRIORS, None if auto else args.n_components[0]
        args.prior = load_face_prior(K) if face else load_model(args.prior)
        n_components = len(args.prior.basis_)
        if args.n_components == (AUTO,):
            args.n_components = None
        if args.camera is None and args.prior.camera_ != "affine":  # which is refused
            args.camera = args.prior.camera_
    args.n_components = args.n_components or (n_components,)


def _check_options(args: Namespace) -> None:
    """Raise before a long fit if options exclude each other or a library is absent."""
    suffixes = {*TABLE_SUFFIXES, *(Path(name).suffix for name in _outputs.RESULTS)}
    if Path(args.output).suffix.lower() in suffixes and not Path(args.output).is_dir():
        raise ValueError(
            f"--output {args.output}: expected a folder, because fit writes several "
            "files; the table of coefficients is alpha.csv in it"
        )
    if not args.no_figures:
        import_optional("matplotlib", extra="plot")
    for name in ("focal_length", "principal_point"):
        if getattr(args, name) is not None and args.camera != "perspective":
            raise ValueError(f"{flag_of(name)} needs --camera perspective")
    joint = {"--std": args.std, "--n-components auto": args.n_components[0] == AUTO}
    for option, is_given in joint.items():
        if is_given and args.refinement not in JOINT_REFINEMENTS:
            raise ValueError(
                f"{option} needs --refinement joint or consensus; got --refinement "
                f"{args.refinement}"
            )
    one = {
        "weights": "numbers are compared without weights",
        "prior": "a fit has those of the prior",
    }
    for name, why in one.items():
        if getattr(args, name) not in (None, NONE) and len(args.n_components) > 1:
            raise ValueError(
                f"{flag_of(name)} needs one number of basis shapes, because {why}; "
                "give it with --n-components, or auto"
            )


def _seconds(clock: dict[str, float]) -> dict[str, float]:
    """Return the seconds of each stage by the times of their ends."""
    of_stages = np.diff([*clock.values()]).round(3)
    return dict(zip([*clock][1:], of_stages, strict=True))


def _fitted(
    args: Namespace, frames: Frames, clock: dict[str, float]
) -> tuple[AffineNRSfM, AffineNRSfMCV | None, Diagnostics | None, dict[str, Any]]:
    """Return model, search for its K, diagnostics of a joint fit, and a comparison.

    The model has perspective cameras if the options leave it open, and these explain
    the table better.
    """
    isa = None
    if args.isa == "fast" or args.n_init is not None:
        strategy = {"pooled": PooledFastICA, "fast": FastISA}[args.isa]
        isa = strategy(**({} if args.n_init is None else {"n_init": args.n_init}))
    given: dict[str, Any] = {
        name: None if getattr(args, name) == NONE else getattr(args, name)
        for name in _PARAMETERS
    }
    near = {"camera": "perspective", "principal_point": frames.principal_point}
    if args.camera is None:
        joint = args.refinement in JOINT_REFINEMENTS
        given["camera"] = "weak_perspective" if joint else "affine"
    elif args.camera == "perspective":
        given |= near
    estimator = AffineNRSfM(
        args.n_components[0],
        isa=isa,
        scale_frames=not args.no_scale_frames,
        hidden_points=not args.no_hidden_points,
        remove_pose=args.remove_pose,
        **given,
    )
    search, X, groups = None, frames.X, frames.groups
    if len(args.n_components) > 1:
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
        search = AffineNRSfMCV(
            args.n_components, estimator=estimator, cv=splitter, verbose=1
        )
        with contextlib.redirect_stdout(sys.stderr):  # results are printed at once
            search.fit(X, groups=groups)
        estimator = search.best_estimator_
        clock["choose"] = time.perf_counter() - search.refit_time_
    else:
        # For `shown_progress`; the model that is written does not have it.
        with warnings.catch_warnings(record=True) as told:
            estimator.set_params(verbose=2).fit(X, groups=groups, **frames.weighting)
        with_prior = _with_face_prior(args, estimator, frames)
        for each in told if with_prior is None else ():
            warnings.warn(each.message, stacklevel=1)
        estimator = with_prior or estimator
    diagnostics = None
    if args.refinement in JOINT_REFINEMENTS:
        diagnostics = estimator.diagnostics(X, **frames.weighting)
    perspective = perspective_report(estimator, frames, diagnostics)
    if perspective["better"] and args.camera is None and args.refinement == "joint":
        show_stage("fit with perspective cameras")
        estimator.set_params(verbose=2, n_components=len(estimator.basis_), **near)
        estimator.fit(X, groups=groups, **frames.weighting)
        diagnostics = estimator.diagnostics(X, **frames.weighting)
    estimator.set_params(verbose=0)
    clock["fit"] = time.perf_counter()
    return estimator, search, diagnostics, perspective


def _with_face_prior(
    args: Namespace, estimator: AffineNRSfM, frames: Frames
) -> AffineNRSfM | None:
    """Return a fit with the face prior, if that and nothing else determines depths."""
    certainty = frames_of(estimator).certainty if args.refinement == "joint" else None
    plain = args.prior is None and estimator.camera_ == "weak_perspective"
    layout = face_layout(args, frames) if plain else None
    if layout is None or certainty is None or certainty.determined:
        return None
    show_stage("fit with the face prior")
    prior = load_face_prior(args.face_components, layout=layout)
    with_prior = clone(estimator).set_params(n_components="auto", prior=prior)
    with warnings.catch_warnings(action="ignore"):
        try:
            with_prior.fit(frames.X, **frames.weighting)
            with_prior.set_params(n_components=len(prior.basis_))
        except ValueError:  # other points
            return None
    if not frames_of(with_prior).certainty.determined:
        return None
    warn_caller(
        "the table by itself does not determine the depth of the shapes (expected "
        f"error {100 * certainty.total:.0f} % of the depth): they are fitted with the "
        f"face prior, as with --prior {FACE_PRIOR} --n-components "
        f"{len(prior.basis_)}, because the layout of the points is {layout}. "
        f"--prior {NONE} fits the table by itself"
    )
    return with_prior


def choice_report(search: AffineNRSfMCV, X: "pd.DataFrame") -> dict[str, Any]:
    """Return the numbers tried, their held-out errors, seconds, and the one chosen.

    Also whether a larger one may be better: it is the largest, and the table supports
    it and allows others.
    """
    results, n_parts = search.cv_results_, search.n_splits_
    tried, chosen = results["param_n_components"], search.n_components_
    of_part = results["mean_fit_time"] + results["mean_score_time"]
    scores = [results[f"split{part}_test_score"] for part in range(n_parts)]
    of_parts = -np.transpose(scores)
    fitted = len(X) - -(-len(X) // N_PARTS)  # frames, of the smallest part
    best = search.best_estimator_
    joint = best.refinement in JOINT_REFINEMENTS
    most = most_components(fitted, X.shape[1] // 2, best.camera_ if joint else None)
    supported = not joint or facts_of(best).n_supported == chosen
    return {
        "n_components": tried.tolist(),
        "held_out_error": -results["mean_test_score"],
        "held_out_error_standard_error": standard_errors(of_parts),
        "held_out_error_of_parts": of_parts,
        "seconds": results["path_fit_time"] + n_parts * of_part,
        "chosen": chosen,
        "larger_may_be_better": bool(supported and chosen == tried[-1] < most),
    }
