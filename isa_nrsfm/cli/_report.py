"""The results and the report of a run: as data, text, JSON and a page.

The report has the SHA-256 digests of the model and the other files of its run. A
section of the page has paragraphs (texts) and tables: titles of the columns, which may
be none, and rows.
"""

import base64
import hashlib
import json
import math
import shlex
import textwrap
import warnings
from argparse import Namespace
from collections.abc import Iterable, Sequence
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM, export
from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import write_whole
from isa_nrsfm._compat.texts import as_utf8, escape, first_items, percent
from isa_nrsfm._fitted_model import frames_of, sees_perspective
from isa_nrsfm.analysis._advice import FIT, camera_meaning, verdict
from isa_nrsfm.analysis._diagnostics import Diagnostics
from isa_nrsfm.analysis._frame_columns import TEXTS
from isa_nrsfm.cli._options import PROGRAM
from isa_nrsfm.cli._reading import MOST_LISTED, Frames, drawing_files
from isa_nrsfm.io import FORMATS, load_model, save_model, write_table
from isa_nrsfm.io._formats import TABLE
from isa_nrsfm.metrics._measures import frame_energies
from isa_nrsfm.skeletons._column_names import names_of_components, names_of_points

PAGE = "report.html"
REPORT = "report.json"
# The files of every fit; docs/command_line.md has their contents.
_TABLES = ("alpha.csv", "cameras.csv", "shapes.csv", "shapes.npz")
RESULTS = (PAGE, "model.npz", *_TABLES, "viewer.html")


class Fit(NamedTuple):
    """A fit to write and draw: model, frames, smoothing, lines.

    ``explained`` is the table of the model.
    """

    estimator: AffineNRSfM
    frames: Frames
    smooth: Any
    drawn: dict[str, Any]
    explained: NDArray


def check_outputs(
    args: Namespace, inputs: Iterable[str], targets: Iterable[Path], own: Any = ()
) -> None:
    """Raise if files of inputs would be replaced, or others but for own ones by name.

    With --force only inputs are kept.
    """
    existing = [target for target in targets if target.exists()]
    for source in (*inputs, *drawing_files(args)):
        if any(target.samefile(source) for target in existing):
            raise ValueError(
                f"{source} would be overwritten by the results: choose another --output"
            )
    others = [str(path) for path in existing if path.is_file() and path.name not in own]
    if others and not args.force:
        raise ValueError(
            f"existing files would be replaced: {', '.join(others)}. Choose another "
            "--output, or replace them with --force"
        )


def write_alpha(
    path: Path, frames: Frames, alpha: NDArray, std: NDArray | None, **further: NDArray
) -> None:
    """Write coefficients after the row number and the other columns of the table.

    Frames that could not be fitted have empty coefficients. Results with the name of
    another column get an underscore.
    """
    names = names_of_components(None, alpha.shape[1])
    results = pd.DataFrame(alpha, index=frames.X.index, columns=names)
    if std is not None:
        results[[f"{name}_std" for name in names]] = std
    results = results.assign(**further).reindex(frames.points.index)
    results.insert(0, "row", results.index)
    taken = {str(name) for name in frames.other.columns}
    if renamed := [name for name in results if name in taken]:
        warn_caller(
            f"the table has columns {', '.join(renamed)}: results of these names have "
            "an underscore after theirs"
        )
    while not taken.isdisjoint(results):
        results = results.rename(columns=lambda name: f"{name}{'_' * (name in taken)}")
    parts = [results.iloc[:, :1], frames.other, results.iloc[:, 1:]]
    write_table(pd.concat(parts, axis=1), path)


def write_results(folder: Path, fit: Fit, unit: float = 1.0, **shown: Any) -> None:
    """Write cameras, shapes, the viewer with the `shown` data, and the model.

    The cameras have a row for each frame, empty if it could not be fitted. `unit` is
    the length of a unit of the shapes, for positions.
    """
    estimator, frames, smooth, drawn, explained = fit
    X, motion = frames.X, estimator.motion_
    names = [*(f"m{i}{j}" for i in range(2) for j in range(3)), "tx", "ty"]
    numbers = np.hstack([motion.reshape(-1, 6), estimator.translation_])
    cameras = pd.DataFrame(numbers, X.index, names)
    energy, error, _ = frame_energies(X, explained, estimator.layout)
    cameras["inverse_snr"] = error / energy
    if hasattr(estimator, "positions_"):
        cameras[[f"position_{axis}" for axis in "xyz"]] = unit * estimator.positions_
    shown["camera"] = None
    if frames_of(estimator).certainty.determined:  # otherwise the fit has warned
        try:
            with warnings.catch_warnings(action="error", category=UserWarning):
                poses = export.frame_poses(estimator, X, **frames.weighting, **drawn)
            columns = pd.DataFrame(poses._asdict(), X.index).dropna(axis=1, how="all")
            shown["camera"] = "weak_perspective" if len(columns.columns) else None
            if smooth is not None:
                poses = export.frame_poses(estimator, smooth.decomposition, **drawn)
                for name in columns.columns.intersection(["yaw", "pitch", "roll"]):
                    columns[f"{name}_smooth"] = getattr(poses, name)
            cameras = cameras.join(columns)
        except (ValueError, UserWarning) as error:
            warn_caller(
                f"viewer.html has affine shapes, and cameras.csv has no angles: {error}"
            )
    cameras = cameras.reindex(frames.points.index).reset_index(names="row")
    write_table(cameras, folder / "cameras.csv")
    shapes = [estimator.mean_shape_, *estimator.basis_]
    names = ["mean", *(f"basis_{k}" for k in range(1, len(shapes)))]
    columns = [f"{name}_{axis}" for name in names for axis in "XYZ"]
    points = pd.DataFrame(np.hstack(shapes), names_of_points(estimator), columns)
    write_table(points.reset_index(names="point"), folder / "shapes.csv")
    export.write_shapes(estimator, folder / "shapes.npz")
    shown |= {"X": X, **frames.weighting, **drawn}
    export.write_viewer(estimator, folder / "viewer.html", **shown)
    save_model(estimator, folder / "model.npz")


def depth_std(args: Namespace, model: AffineNRSfM, X: Any, weights: Any) -> Any:
    """Return the error bars of the viewer as its argument, if --std asks for them."""
    if not args.std or model.camera_ == "affine":
        return {}
    return {"depth_std": model.reconstruct(X, return_std=True, **weights)[1]}


def read_model(args: Namespace) -> AffineNRSfM:
    """Load a model; its missing points have the coordinates of those of its fit.

    These are in the report beside the model. Without a report of that model there are
    none. Warn if files beside it are not of the run of the report.
    """
    estimator, path = load_model(args.model), Path(args.model)
    folder, recorded = path.parent, entry_of_report(path.parent, "sha256")
    if path.name not in recorded:  # without a report, or with one of something else
        return estimator
    beside = digests_of(folder, [each for each in recorded if Path(each).name == each])
    differing = [each for each in beside if beside[each] != recorded[each]]
    if differing:
        warn_caller(
            f"{folder / REPORT} is of another run than {', '.join(differing)} beside "
            "it, or these were changed since"
        )
    if path.name not in differing:
        missing = entry_of_report(folder, "table").get("missing_values", [])
        args.missing_value = [*args.missing_value, *missing]
    return estimator


def entry_of_report(folder: Path, name: str) -> dict[str, Any]:
    """Return an entry of the report in a folder, without one an empty dict."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
        return dict(report[name])
    except (OSError, ValueError, TypeError, KeyError):
        return {}


def digests_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the digests of the named files that exist in a folder."""
    existing = {name: folder / name for name in names if (folder / name).is_file()}
    return {n: hashlib.sha256(f.read_bytes()).hexdigest() for n, f in existing.items()}


# Classes whose means are shown, at most.
MOST_CLASSES = 12


def table_report(args: Namespace, frames: Frames) -> dict[str, Any]:
    """Describe the table, its rows and columns that are used, and the others."""
    X, names = frames.X, list(frames.points.columns)
    missing = X.iloc[:, ::2].isna().to_numpy()
    return {
        "path": str(Path(args.table).resolve()),
        "format": args.format,
        "n_rows": len(frames.images),
        "n_frames": len(X),
        "n_points": len(frames.columns.points),
        "missing_values": args.missing_value,
        "n_missing_points": missing.sum(),
        "n_frames_with_missing_points": missing.any(axis=1).sum(),
        "columns": frames.columns.pattern,
        "first_columns": names[:4],
        "last_columns": names[-2:],
        "coordinates_not_used": frames.not_used,
        "rows_left_out": frames.left_out,
    }


def quality_report(error: float, square: float, weighted: bool) -> dict[str, Any]:
    """Describe how well a model explains a table, whose points may have weights.

    `error` is that of held-out points, `square` the mean of the squared errors of the
    coordinates.
    """
    return {
        "fit": verdict(error, *FIT),
        "held_out_error": error,
        "held_out_error_weighted": weighted,
        "rms_point_error": np.sqrt(2 * square),
    }


def model_report(fit: Fit, found: Diagnostics | None) -> dict[str, Any]:
    """Describe a fitted model, with the diagnostics of a joint fit, and its quality."""
    # Not needed by transform
    from isa_nrsfm.plotting._views import SPANNING_TREE, view_and_layout

    estimator, frames, edges = fit.estimator, fit.frames, fit.drawn["edges"]
    X, alpha = frames.X, estimator.alpha_
    square = (fit.explained - X.to_numpy()) ** 2
    errors, typical = np.sqrt(2 * np.nanmean(square, axis=1)), np.nanmean(square)
    if estimator.loss != "linear":  # of the median point
        typical = np.nanmedian(square[:, ::2] + square[:, 1::2]) / np.log(4)
    ratio = getattr(estimator, "camera_noise_ratio_", np.nan)
    _, layout, lines, _ = view_and_layout(estimator, edges)
    for message in getattr(found, "messages", ()):
        warn_caller(message)
    error = found.held_out_error if found else -estimator.score(X, **frames.weighting)
    figures = ("effective_frames", "pose_share", "pose_removed")
    coefficients = {
        "name": names_of_components(None, alpha.shape[1]),
        "energy_share": estimator.energy_share_,
        "min": alpha.min(axis=0),
        "row_of_min": X.index[alpha.argmin(axis=0)],
        "max": alpha.max(axis=0),
        "row_of_max": X.index[alpha.argmax(axis=0)],
        "stability": getattr(estimator, "stability_", None),
        "stability_word": getattr(found, "stability", None),
        **{name: getattr(found, name, None) for name in figures},
    }
    outliers = None
    if found is not None:
        names, worst = names_of_points(estimator), found.outliers[:MOST_LISTED]
        largest = [{"row": X.index[i], "point": names[j]} for i, j in worst]
        outliers = {"share": found.outlier_share, "largest": largest}
        outliers["n_points"] = len(found.outliers)
    return {
        "n_components": alpha.shape[1],
        "depth": getattr(found, "depth", ""),
        "inverse_snr": estimator.inverse_snr_,
        **quality_report(error, typical, bool(frames.weighting)),
        "largest_error": {"row": X.index[errors.argmax()], "rms": errors.max()},
        "noise_variance": getattr(estimator, "noise_variance_", None),
        "frames_scaled": estimator.frames_scaled_,
        "camera": estimator.camera,
        "camera_noise_ratio": ratio,
        "camera_meaning": camera_meaning(ratio),
        "depth_uncertainty": getattr(estimator, "depth_uncertainty_", None),
        "mirror_certainty": estimator.mirror_certainty_,
        "mirror_decided_by_perspective": sees_perspective(estimator),
        "focal_length": getattr(estimator, "focal_length_", None),
        "focal_length_std": getattr(estimator, "focal_length_std_", None),
        "principal_point": estimator.principal_point,
        "depth_determined": estimator.camera_ != "affine"
        and frames_of(estimator).certainty.determined,
        "skeleton": None if layout is None else layout.name,
        # Also if no lines are wanted.
        "lines_known": edges is None
        or getattr(lines, "name", SPANNING_TREE) != SPANNING_TREE,
        "outliers": outliers,
        "parameters": estimator.get_params(deep=True),
        "alpha": pd.DataFrame(coefficients).to_dict("records"),
    }


# Coefficients in the summary, at most; its texts in lines, without a break in paths.
MOST_SHOWN = 5
WRAPPED = textwrap.TextWrapper(80, break_on_hyphens=False, break_long_words=False)


Section = Sequence[str | Sequence[Sequence[str]]]


def fit_title(report: dict[str, Any]) -> str:
    """Return the title of the report of a fit."""
    table, n = report["table"], len(report["model"]["alpha"])
    layout = f" ({name})" if (name := report["model"]["skeleton"]) else ""
    rows = f"{table['n_frames']} frames of {table['n_points']} points{layout}"
    return f"{n} movement{'s' * (n != 1)} in {rows}"


def summary(report: dict[str, Any], folder: Path | str) -> list[list[str]]:
    """Return what a fit has found in a few rows: a name, a mark, and a text.

    The terminal and the page begin with it, and `report.json` has it.
    """
    model, table = report["model"], report["table"]
    rows = [quality_row(model), ["depth", model["depth"].upper(), _depth(model)]]
    for row in model["alpha"][:MOST_SHOWN]:
        text = f"from row {row['row_of_min']} to row {row['row_of_max']}"
        if share := _pose_share(row):
            text = f"pose explains {share}; {text}"
        rows.append([row["name"], f"{100 * row['energy_share']:.0f} %", text])
    if more := len(model["alpha"][MOST_SHOWN:]):
        rows.append(["", "", f"{more} more in {PAGE}"])
    rows += [["label", "", _answer(label)] for label in report.get("labels", ())]
    if "between" in report.get("groups", ()):
        groups = report["groups"]
        largest = int(np.argmax(groups["between"]))
        name, share = model["alpha"][largest]["name"], groups["between"][largest]
        text = f"{100 * share:.0f} % of the variance of {name} is between groups"
        rows.append(["group", "", f"{groups['column']}: {text}"])
    if "time" in report:
        rows.append(["time", "", str(_time(report["time"])[0])])
    trials, tried = report["tried"], []
    if choice := report.get("choice"):
        names = ("n_components", "held_out_error", "held_out_error_standard_error")
        each = zip(*(choice[name] for name in names), strict=True)
        found = (f"{k} ({100 * error:.3g} +- {100 * s:.2g} %)" for k, error, s in each)
        tried = [f"K = {first_items(found, 12)}: {choice['chosen']} is used"]
    tried += [each["text"] for each in trials if each["seconds"]]
    others = [f"{e['setting']} ({e['result']})" for e in trials if not e["seconds"]]
    tried += [f"not tried: {'; '.join(others)}"] * bool(others)
    rows += [["tried" * (not i), "", text] for i, text in enumerate(tried)]
    rows.append(left_out_row(table))
    if columns := table.get("other_columns"):
        text = f"--label, --group or --time COLUMN: {first_items(columns, 6)}"
        rows.append(["next", "", text])
    return [*rows, ["open", "", f"{Path(folder, PAGE)}  viewer.html  alpha.csv"]]


def _pose_share(row: dict[str, Any]) -> str:
    """Return the share of a coefficient that the pose explains, if it is known."""
    share = row["pose_share"]
    return f"{100 * max(share, 0):.0f} %" if pd.notna(share) else ""


def _depth(model: dict[str, Any]) -> str:
    """Return how well the depth is known, and which of the mirror images it is."""
    error, mirror = model["depth_uncertainty"], model["mirror_certainty"]
    if not model["depth"]:
        return "affine cameras leave it open, and angles and proportions with it"
    if not model["depth_determined"]:
        return f"not determined (off by {100 * error:.0f} %): no angles and proportions"
    text = f"known to {100 * error:.2g} %"
    if not mirror or not math.isfinite(mirror):
        return f"{text}; its mirror image is as likely"
    certainty = min(math.floor(1000 * mirror) / 10, 99.9)
    return f"{text}; the right one of two mirror images with {certainty:g} %"


def _answer(label: dict[str, Any]) -> str:
    """Return whether a label goes with coefficients."""
    if label["untested"]:
        return f"{label['column']} was not tested: {label['untested']}."
    names = names_of_components(None, len(label["values"]))
    related = np.asarray(names)[np.less(label["p_values"], 0.05)]
    coefficients = ", ".join(related) or "no coefficient"
    return f"{label['column']} goes with {coefficients} (p < 0.05)."


def fit_sections(report: dict[str, Any]) -> dict[str, Section]:
    """Return the sections of the page of a fit, answers first, without figures."""
    labels = map(_label, report.get("labels", ()))
    versions = (f"{name} {each}" for name, each in report["versions"].items())
    return {
        "Labels": [part for parts in labels for part in parts],
        "Groups": _groups(report["groups"]) if "groups" in report else (),
        "Time": _time(report["time"]) if "time" in report else (),
        "Alpha": _alpha(report["model"]),
        "Fit": _fit(report),
        "Table": table_section(report["table"]),
        "Command": [shlex.join([PROGRAM, *report["arguments"]])],
        "Versions": [", ".join(versions)],
    }


def table_section(table: dict[str, Any]) -> Section:
    """Return the rows and columns of a table that are used, and the others."""
    format, out = table["format"], left_out_row(table)[2]
    listed = ", ".join([*table["first_columns"], "...", *table["last_columns"]])
    unused = [f"{name} ({n})" for name, n in table["coordinates_not_used"].items()]
    others = {"coordinates not used": unused, "other columns": table["other_columns"]}
    shown = {what: first_items(names, MOST_LISTED) for what, names in others.items()}
    return [
        table["path"] + ("" if format == TABLE else f" ({FORMATS[format].title})"),
        f"{table['n_points']} points in the columns {listed}",
        f"{table['n_frames']} of {table['n_rows']} rows; left out: {out}",
        *(f"{what}: {names}" for what, names in shown.items() if names),
    ]


def quality_row(quality: dict[str, Any]) -> list[str]:
    """Return how well points are explained, as a row of a summary."""
    off = f"points are off by {quality['rms_point_error']:.3g} in the unit of the table"
    text = f"{percent(quality['held_out_error'])} of left-out points unexplained"
    return ["fit", quality["fit"].upper(), f"{off}; {text}"]


def left_out_row(table: dict[str, Any]) -> list[str]:
    """Return the rows that are left out, and missing points, as a row of a summary."""
    out = [f"{e['n_rows']} rows: {e['reason']}" for e in table["rows_left_out"]]
    numbers = [f"({n:.15g}, {n:.15g})" for n in table["missing_values"]]
    out += [f"points at {place} count as missing" for place in numbers]
    if n_missing := table["n_missing_points"]:
        share = n_missing / (table["n_frames"] * table["n_points"])
        rows = f"in {table['n_frames_with_missing_points']} of the others"
        out.append(f"{n_missing} points ({percent(share)}) are missing {rows}")
    return ["left out", "", "; ".join(out) or "no row"]


def text_of(title: str, rows: Sequence[Sequence[str]]) -> str:
    """Return a summary as text: rows of a name, a mark, and a text that is wrapped."""
    lines = [title] * bool(title)
    for name, mark, text in rows:
        start = f"{name:9}{mark:6}" if mark else f"{name:9}"
        lines.append(start + f"\n{'':{len(start)}}".join(WRAPPED.wrap(text)))
    return "\n".join(lines)


def write_report(folder: Path, report: dict[str, Any]) -> dict[str, Any]:
    """Write the report of a fit as a page and as JSON; return it with digests."""
    _write_page(folder, report)
    digests = report.get("sha256", {}) | digests_of(folder, report["files"])
    report = report | {"sha256": digests}
    text = json.dumps(_plain(report), indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(folder / REPORT, f"{text}\n".encode())
    return report


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it, NaN as null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {as_utf8(str(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, int):
        return value
    return as_utf8(value if isinstance(value, str) else repr(value))


def _write_page(folder: Path, report: dict[str, Any]) -> None:
    """Write the report of a fit as a page, with the figures of the folder in it."""
    title = escape(fit_title(report))
    about = escape(f"{report['table']['path']}, {report['finished']}")
    parts = [f"<h1>{title}</h1>", f'<p class="quiet">{about}</p>']
    parts += _markup("", [[[], *report["summary"]]])
    for warning in report["warnings"]:
        parts.append(f'<p class="advice">{escape(_sentence(warning))}</p>')
    parts.append('<p><a href="viewer.html">Shapes and frames in 3D</a></p>')
    figures = {n: text for n, text in report["files"].items() if n.endswith(".png")}
    for section, content in fit_sections(report).items():
        parts += _markup(section, content)
        for name in figures if section == "Alpha" else ():  # after the answers
            image = base64.b64encode((folder / name).read_bytes()).decode()
            caption = escape(figures[name])
            parts.append(
                f'<figure><img src="data:image/png;base64,{image}" alt="{caption}">'
                f"<figcaption>{caption}</figcaption></figure>"
            )
    page = Path(__file__).with_name(PAGE).read_text(encoding="utf-8")
    page = page.replace("{{title}}", title).replace("{{content}}", "\n".join(parts))
    write_whole(folder / PAGE, page.encode(errors="replace"))


def _markup(name: str, parts: Section) -> list[str]:
    """Return the HTML of a section, of an empty one nothing."""
    found = [f"<h2>{name}</h2>"] if parts and name else []
    for part in parts:
        if isinstance(part, str):
            found.append(f"<p>{escape(part)}</p>")
            continue
        head, *rows = part
        # Numbers are aligned to the right.
        numbers = [
            any(column) and all(cell[:1] in "+-0123456789" for cell in column)
            for column in zip(*rows, strict=True)
        ]
        found.append('<div class="wide"><table>')
        for row in part[not head :]:
            tag = "th" if row is head else "td"
            cells = (
                f"<{tag}{' class=number' * is_number}>{escape(cell)}</{tag}>"
                for cell, is_number in zip(row, numbers, strict=False)
            )
            found.append(f"<tr>{''.join(cells)}</tr>")
        found.append("</table></div>")
    return found


def _fit(report: dict[str, Any]) -> Section:
    """Return the numbers of the fit and its cameras, with what they mean."""
    model, table = report["model"], report["table"]
    square, mirror = model["noise_variance"], model["mirror_certainty"]
    worst, determined = model["largest_error"], model["depth_determined"]
    weighted = " Points count by their weights." * model["held_out_error_weighted"]
    parts = [
        f"held-out error {percent(model['held_out_error'])}: energy of the errors of "
        "points that are predicted from the other points of their frame, relative to "
        f"that of the centred points.{weighted}"
        + " It is that of the median point, as outliers have less weight."
        * (model["parameters"]["loss"] != "linear"),
        f"largest error of a frame: {worst['rms']:.3g}, of row {worst['row']}",
    ]
    if square is not None:
        noise = f"{math.sqrt(square):.3g} in the units of the table"
        if model["frames_scaled"]:
            noise = f"{percent(math.sqrt(square))} of the frame's size"
        parts.append(f"noise in the fit {noise} (standard deviation of a coordinate)")
    if "prior" in report:
        name, (width, _) = report["prior"]["name"], report["prior"]["std"]
        parts.append(
            f"prior {name}: the mean shape differs by {100 * width:.2g} % of the size "
            "of the object from that of the prior (standard deviation of a coordinate)."
            " Coefficients are those of the prior, so that studies with the same prior "
            "can be compared."
        )
    if model["skeleton"] is None and not model["lines_known"]:
        parts.append(
            f"{table['n_points']} points of no known layout: give lines of figures and "
            "viewer with --edges FILE or --skeleton LAYOUT. If they are upside down, "
            "use --origin lower."
        )
    if determined and mirror and math.isfinite(mirror):
        which = "missing points are farther away"
        if model["mirror_decided_by_perspective"]:
            which = "perspective fits"
        elif model["parameters"]["prior"] is not None:
            which = "the prior is alike"
        parts.append(f"mirror image in depth: the one for which {which}")
    parts += _perspective(model, report.get("position_unit"))
    if determined and not np.isnan(model["camera_noise_ratio"]):
        parts.append(_sentence(model["camera_meaning"]))
    return parts


def _perspective(model: dict[str, Any], unit: dict[str, Any] | None) -> list[str]:
    """Return focal length and unit of positions of perspective cameras."""
    focal = model["focal_length"]
    if focal is None:
        return []
    if not math.isfinite(focal):
        return ["no perspective: the focal length is too long to estimate it"]
    (x, y), origin, length = model["principal_point"], "given", "units of the shapes"
    if model["parameters"]["focal_length"] is None:
        origin = f"estimated, standard deviation {model['focal_length_std']:.2g}"
    if unit is not None:
        a, b = unit["points"]
        length = f"points {a} and {b} of the mean shape are {unit['length']:g} apart"
    focal = f"focal length {focal:.4g} ({origin}), principal point ({x:g}, {y:g})"
    return [focal, f"positions in cameras.csv: {length}"]


def _alpha(model: dict[str, Any]) -> Section:
    """Return the distribution of the coefficients, and what the pose predicts."""
    head = ["", "energy", "min", "row", "max", "row", "pose", "again"]
    rows = [
        [
            row["name"],
            f"{100 * row['energy_share']:.1f} %",
            f"{row['min']:z.2f}",
            f"{row['row_of_min']}",
            f"{row['max']:z.2f}",
            f"{row['row_of_max']}",
            _pose_share(row),
            row["stability_word"] or "",
        ]
        for row in model["alpha"]
    ]
    columns = [True] * 6 + [any(row[k] for row in rows) for k in (6, 7)]
    table = [[*compress(line, columns)] for line in (head, *rows)]
    notes = [
        "energy: share of the deformation in the images (sum of squares)",
        "pose: variance that yaw, pitch and roll predict, cross-validated",
        "again: whether a fit of other people has the coefficient, with a correlation "
        "of at least .85",
    ]
    parts = [table, *compress(notes, columns[5:])]
    if model["parameters"]["remove_pose"]:
        largest = max(model["alpha"], key=lambda row: row["pose_removed"] or 0.0)
        share = f"{100 * (largest['pose_removed'] or 0.0):.0f} % of {largest['name']}"
        parts.append(
            f"--remove-pose: what yaw predicts was removed, up to {share}. It assumes "
            "that the objects move alike in all views"
        )
    return parts


def _label(label: dict[str, Any]) -> Section:
    """Return how coefficients depend on a label."""
    title = f"{label['column']}: {label['n_frames']} frames"
    if "classes" in label:
        title += f" of {len(label['classes'])} classes"
    copies = "copies of other frames count once with them"
    counts = {"n_copies": copies, "n_without_label": "without a label left out"}
    title += "".join(f"; {label[n]} {what}" for n, what in counts.items() if label[n])
    names = names_of_components(None, len(label["values"]))
    statistic, meaning = TEXTS["statistics"][label["kind"]]
    columns = {"": names, statistic: [f"{value:z.2f}" for value in label["values"]]}
    columns["p"] = ["" if label["untested"] else f"{p:.3f}" for p in label["p_values"]]
    if label["corrected"] is not None:
        columns["corrected"] = [f"{value:z.2f}" for value in label["corrected"]]
        meaning += "; corrected: without the errors of the coefficients"
    test, means = "no p-values", "class_means" in label and not label["untested"]
    if not label["untested"]:
        test = f"corrected p-values: permutations of {label['permuted']}"
    return [
        _answer(label),
        title,
        [[*columns], *zip(*columns.values(), strict=True)],
        f"{statistic}: {meaning}; {test}",
        *(_class_means(label, names) if means else ()),
        _score(label),
    ]


def _score(label: dict[str, Any]) -> str:
    """Return how well coefficients predict a label, compared with PCA."""
    if "not_cross_validated" in label:
        return f"not cross-validated: {label['not_cross_validated']}"
    classes, names = label["score"] == "accuracy", ("", "_standard_error")

    def shown(name: str) -> str:
        score, error = ((1, 100)[classes] * label[name + each] for each in names)
        return f"{score:.{2 - classes}f} +- {error:.{2 - classes}f}{' %' * classes}"

    others = [
        f"{shown(name)} ({label[f'{name}_n_features']} components)"
        for name in ("cross_validated_pca", "cross_validated_pca_of_rank")
    ]
    if classes:
        others.append(f"largest class {100 * label['largest_class']:.1f} %")
    return (
        f"cross-validated {('R^2', 'accuracy')[classes]} {shown('cross_validated')} "
        f"(standard error); PCA of the aligned frames {', '.join(others)}"
    )


def _class_means(label: dict[str, Any], names: Sequence[str]) -> list[str]:
    """Return the means of the classes of significant coefficients, largest first."""
    lines = ["mean of each class if p < 0.05, in standard deviations:"]
    means = pd.DataFrame(label["class_means"], names)
    note = " (all in report.json)" * (len(means.columns) > MOST_CLASSES)
    for name, row in means[np.less(label["p_values"], 0.05)].iterrows():
        largest = row.sort_values(key=lambda mean: -mean.abs(), kind="stable")
        listed = (f"{each} {mean:+z.1f}" for each, mean in largest.items())
        lines.append(f"{name}: {first_items(listed, MOST_CLASSES)}{note}.")
    return lines if len(lines) > 1 else []


def _groups(groups: dict[str, Any]) -> Section:
    """Return how much coefficients differ between groups."""
    column = groups["column"]
    if "not_divided" in groups:
        return [f"{column}: {groups['not_divided']}"]
    names = names_of_components(None, len(groups["between"]))
    shares = zip(names, groups["between"], groups["within"], strict=True)
    rows = [[name, f"{100 * a:.1f} %", f"{100 * b:.1f} %"] for name, a, b in shares]
    title = f"{column}: variance between and within {groups['n_groups']} groups"
    return [title, [["", "between", "within"], *rows]]


def _time(time: dict[str, Any]) -> Section:
    """Return the result of smoothing in time."""
    scales = np.asarray(time["time_scales"], dtype=float)
    name = time["column"]
    if (frames := time.get("frames")) is not None:
        name = f"frames {frames[0]:g} to {frames[1]:g} by {name or 'row'}"
    if not len(scales):
        return [f"{name}: no dynamics found, coefficients are not smoothed"]
    fading = scales[np.isfinite(scales)]
    listed = first_items(f"{each:.3g}" for each in fading)
    constants = f"time constants of the deformation: {listed} {time['unit']}"
    found = [constants] * bool(listed)
    if lasting := len(scales) - len(fading):
        found.append(f"changes last in {lasting} of {len(scales)} directions")
    return [
        f"{name}: {'; '.join(found)}",
        f"smoothed coefficients differ by {time['changed_by']:.2f} (root mean square)",
    ]


def _sentence(text: str) -> str:
    """Return a text as a sentence; names of files stay as they are."""
    if text.partition(" ")[0].isalpha():
        text = text[:1].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else f"{text}."
