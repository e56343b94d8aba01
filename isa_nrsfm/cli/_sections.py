"""The sections of a report, and how the report becomes text, JSON and a page.

A section has paragraphs (texts) and tables (`Cells`).
"""

import base64
import json
import math
import shlex
import textwrap
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.texts import as_utf8, escape, first_items, percent
from isa_nrsfm._compat.whole_files import write_whole
from isa_nrsfm.analysis._frame_columns import STATISTICS
from isa_nrsfm.cli._options import AUTO, PROGRAM
from isa_nrsfm.cli._outputs import PAGE, REPORT, digests_of
from isa_nrsfm.cli._report import MOST_CLASSES, MOST_LISTED
from isa_nrsfm.export._names import names_of_components
from isa_nrsfm.io import FORMATS
from isa_nrsfm.io._formats import TABLE
from isa_nrsfm.skeletons import SKELETONS

_CAMERAS = {
    "affine": "affine: shapes are known up to an affine transformation of space. "
    "Angles and proportions need --camera weak_perspective.",
    "weak_perspective": "weak-perspective: shapes are known up to size and a mirror "
    "image in depth",
    "orthographic": "orthographic: shapes are known up to a mirror image in depth, in "
    "the units of the table",
    "perspective": "perspective: shapes are known up to size",
}

_DATA = {REPORT: "the numbers of this report, for programs"}
# Rows of a table in the terminal, at most.
MOST_SHOWN = 16


class Cells(NamedTuple):
    """A table: titles of the columns if they have any, rows, and a title."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""

    @property
    def lines(self) -> Sequence[Sequence[str]]:
        """The rows, after the head if there is one."""
        return [self.head, *self.rows] if self.head else self.rows

    @property
    def numbers(self) -> list[bool]:
        """Which columns have numbers, and are aligned to the right."""
        return [
            any(column) and all(cell[:1] in "+-0123456789" for cell in column)
            for column in zip(*self.rows, strict=True)
        ]


Section = Sequence[str | Cells]
Sections = Mapping[str, Section]


def fit_title(report: dict[str, Any]) -> str:
    """Return the title of the report of a fit."""
    table, basis = report["table"], _shapes(report["model"])
    return f"{basis} fitted to {table['n_frames']} frames of {table['n_points']} points"


def fit_sections(report: dict[str, Any]) -> dict[str, Section]:
    """Return the sections of the report of a fit, answers first, without the files."""
    model = report["model"]
    sections: dict[str, Section] = {}
    if "labels" in report:
        labels = [_label(label) for label in report["labels"]]
        sections["Labels"] = [part for parts in labels for part in parts]
    if "groups" in report:
        sections["Groups"] = _groups(report["groups"])
    if "time" in report:
        sections["Time"] = _time(report["time"])
    sections["Alpha"] = _alpha(model)
    if "choice" in report:
        sections["Choice"] = _choice(report["choice"])
    elif model["parameters"]["n_components"] == AUTO:
        sections["Choice"] = [f"K = {model['n_components']}: found by {AUTO}"]
    sections["Fit"] = _fit(report)
    sections["Cameras"] = _cameras(model, report.get("position_unit"))
    return sections | {"Table": table_section(report["table"])}


def table_section(table: dict[str, Any], unusable: str = "left out") -> Section:
    """Return the rows and columns of a table that are used, and the others."""
    format, n_missing = table["format"], table["n_missing_points"]
    listed = ", ".join([*table["first_columns"], "...", *table["last_columns"]])
    parts: list[str | Cells] = [
        table["path"] + ("" if format == TABLE else f" ({FORMATS[format].title})"),
        f"{table['n_points']} points in the columns {listed}",
    ]
    if table["coordinates_not_used"]:
        not_used = table["coordinates_not_used"].items()
        listed = "; ".join(f"{pattern} ({n_points})" for pattern, n_points in not_used)
        parts.append(f"coordinates not used: {listed}")
    if table.get("other_columns"):
        listed = first_items(map(str, table["other_columns"]), MOST_LISTED)
        parts.append(
            f"other columns: {listed}. Use --label COLUMN to see how coefficients "
            "depend on one, --group COLUMN for people or videos, and --time COLUMN."
        )
    rows = [[f"{table['n_rows']}", "rows"]]
    for out in table["rows_left_out"]:
        result = "left out" if out["skipped_on_request"] else unusable
        rows.append([f"{out['n_rows']}", f"{result}: {out['reason']}"])
    parts.append(Cells([], [*rows, [f"{table['n_frames']}", "used"]]))
    for number in table["missing_values"]:
        parts.append(f"points at ({number:.15g}, {number:.15g}) count as missing")
    if n_missing:
        share = n_missing / (table["n_frames"] * table["n_points"])
        parts.append(
            f"{n_missing} points ({percent(share)}) are missing in "
            f"{table['n_frames_with_missing_points']} of these rows"
        )
    return parts


def quality_section(quality: dict[str, Any], remark: str = "") -> list[str | Cells]:
    """Return the quality of a fit, with a remark on its inverse SNR."""
    weighted = ""
    if quality["held_out_error_weighted"]:
        weighted = (
            " Points count by their weights here, and equally in the inverse SNR."
        )
    return [
        f"inverse SNR {percent(quality['inverse_snr'])}{remark}: energy (sum of "
        "squares) of the residuals, relative to that of the centred points.",
        f"held-out error {percent(quality['held_out_error'])}: the same for points "
        f"predicted from the other points of their frame.{weighted} Wrong points and "
        "too many basis shapes make it much larger.",
        f"reprojected points are off by {quality['rms_point_error']:.3g} (root mean "
        "square, in pixels or the unit of the table)",
    ]


def text_of(title: str, sections: Sections) -> str:
    """Return a report as text, with the name of each section beside its lines."""
    blocks = [title] if title else []
    for name, parts in sections.items():
        lines = [line for part in parts for line in _lines(part)]
        labels = [name] + [""] * (len(lines) - 1)
        beside = zip(labels, lines, strict=True)
        blocks.append("\n".join(f"{name:11}{line}".rstrip() for name, line in beside))
    return "\n\n".join(blocks)


def fit_text(report: dict[str, Any], folder: Path, more: Sections) -> str:
    """Return the report of a fit as text, with more sections after it."""
    described = [
        [name, content.partition(";")[0].partition(": the image")[0]]
        for name, content in (report["files"] | _DATA).items()
    ]
    listed: Section = [f"in {folder}", Cells([], described)]
    sections = fit_sections(report) | {"Files": listed, **more}
    return text_of(fit_title(report), sections | {"Open": [f"{folder / PAGE}"]})


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
        return value if np.isfinite(value) else None
    if value is None or isinstance(value, int):
        return value
    return as_utf8(value if isinstance(value, str) else repr(value))


def _write_page(folder: Path, report: dict[str, Any]) -> None:
    """Write the report of a fit as a page, with the figures of the folder in it."""
    title = escape(fit_title(report))
    about = escape(f"{report['table']['path']}, {report['finished']}")
    parts = [f"<h1>{title}</h1>", f'<p class="quiet">{about}</p>']
    for warning in report["warnings"]:
        parts.append(f'<p class="advice">{escape(_sentence(warning))}</p>')
    parts.append('<p><a href="viewer.html">Shapes and frames in 3D</a></p>')
    sections = fit_sections(report)
    for name in ("Labels", "Groups", "Time", "Alpha"):
        parts += _markup(name, sections.pop(name, ()))
    for name, content in report["files"].items():
        if name.endswith(".png"):
            image = base64.b64encode((folder / name).read_bytes()).decode()
            caption = escape(content)
            parts.append(
                f'<figure><img src="data:image/png;base64,{image}" alt="{caption}">'
                f"<figcaption>{caption}</figcaption></figure>"
            )
    sections["Command"] = [shlex.join([PROGRAM, *report["arguments"]])]
    found = report["versions"].items()
    sections["Versions"] = [", ".join(f"{name} {each}" for name, each in found)]
    sections["Files"] = [Cells([], [*(report["files"] | _DATA).items()])]
    for name, section in sections.items():
        parts += _markup(name, section)
    page = (files("isa_nrsfm.cli") / PAGE).read_text(encoding="utf-8")
    page = page.replace("{{title}}", title).replace("{{content}}", "\n".join(parts))
    write_whole(folder / PAGE, page.encode(errors="replace"))


def _lines(part: str | Cells) -> list[str]:
    """Return the lines of a part: sentences, which end with a point, are wrapped.

    Tables with a head end after `MOST_SHOWN`.
    """
    if isinstance(part, str):
        if part.endswith("."):
            return textwrap.wrap(part, 90, break_on_hyphens=False)
        return [part]
    columns = []
    cells = zip(*part.lines, strict=True)
    for column, is_number in zip(cells, part.numbers, strict=True):
        align, width = ">" if is_number else "<", max(map(len, column))
        columns.append([f"{cell:{align}{width}}" for cell in column])
    rows = ["  ".join(row).rstrip() for row in zip(*columns, strict=True)]
    if part.head and (more := len(rows[MOST_SHOWN:])):
        rows[MOST_SHOWN:] = [f"... {more} more in {PAGE}"]
    return [part.title, *rows] if part.title else rows


def _markup(name: str, parts: Section) -> list[str]:
    """Return the HTML of a section, of an empty one nothing."""
    found = [f"<h2>{name}</h2>"] if parts else []
    for part in parts:
        if isinstance(part, str):
            found.append(f"<p>{escape(part)}</p>")
            continue
        if part.title:
            found.append(f"<h3>{escape(part.title)}</h3>")
        found.append('<div class="wide"><table>')
        for i, row in enumerate(part.lines):
            tag = "th" if part.head and not i else "td"
            cells = (
                f"<{tag}{' class=number' * is_number}>{escape(cell)}</{tag}>"
                for cell, is_number in zip(row, part.numbers, strict=True)
            )
            found.append(f"<tr>{''.join(cells)}</tr>")
        found.append("</table></div>")
    return found


def _fit(report: dict[str, Any]) -> Section:
    """Return the quality of the fit, its noise and its time."""
    model, seconds = report["model"], report["seconds"]
    remark = ""
    if model["parameters"]["loss"] != "linear":
        remark = " (outliers count fully)"
    elif (model["rank_floor"] or 0) > np.finfo(float).eps and "prior" not in report:
        floor = percent(model["rank_floor"])
        remark = f" (no model with {_shapes(model)} is below {floor})"
    parts = quality_section(model, remark)
    worst = model["largest_error"]
    parts.append(f"largest error of a frame: {worst['rms']:.3g}, of row {worst['row']}")
    if model["noise_variance"] is not None:
        noise = math.sqrt(model["noise_variance"])
        size = f"{percent(noise)} of the frame's size"
        if not model["frames_scaled"]:
            size = f"{noise:.3g} in the units of the table"
        parts.append(f"noise in the fit {size} (standard deviation of a coordinate)")
    if "prior" in report:
        parts.append(_prior(report["prior"]))
    fit = seconds["fit"] + seconds.get("choose", 0.0)
    parts.append(f"{sum(seconds.values()):.1f} seconds, {fit:.1f} of them for the fit")
    if model["skeleton"] is not None:
        parts.append(f"points recognised as {model['skeleton']}")
    elif model["n_edges"] == 0 or model["spanning_tree"]:
        drawn = "join them by a minimal spanning tree; give lines"
        if not model["spanning_tree"]:
            drawn = "have no lines between them; give these"
        n_points = report["table"]["n_points"]
        alike = [s.name for s in SKELETONS.values() if s.n_points == n_points]
        parts.append(
            f"points of no known layout: figures and viewer {drawn} with --edges FILE "
            "or --skeleton LAYOUT"
            + (f" (of {n_points} points: {', '.join(alike)})" if alike else "")
            + ". If they are upside down, y points up in the table: use --origin lower."
        )
    return parts


def _prior(prior: dict[str, Any]) -> str:
    """Return how far the shapes are from those of the prior, and what that means."""
    return (
        f"prior {prior['name']}: the mean shape differs by {100 * prior['std'][0]:.2g} "
        "% of the size of the object from that of the prior (standard deviation of a "
        "coordinate). Coefficients are those of the prior, so that studies with the "
        "same prior can be compared."
    )


def _cameras(model: dict[str, Any], unit: dict[str, Any] | None) -> Section:
    """Return the camera model, the certainty of the depth, and what the noise means."""
    title, uncertainty = _CAMERAS[model["camera"]], model["depth_uncertainty"]
    if model["camera"] != "affine" and not model["depth_determined"]:
        return [
            f"{title.partition(':')[0]}: the depth is not determined. cameras.csv has "
            "no angles, and proportions in viewer.html are not true.",
            *_perspective(model, unit),
        ]  # the ratio of the noise means nothing
    if model["camera"] == "perspective" and not model["mirror_decided_by_perspective"]:
        title += " and a mirror image in depth"
    parts = [title, *_perspective(model, unit)]
    if uncertainty and math.isfinite(uncertainty):
        parts.append(
            f"expected depth error: {100 * uncertainty:.2g} % of the depth (root mean "
            "square)"
        )
    mirror = model["mirror_certainty"]
    if mirror and math.isfinite(mirror):
        least = min(math.floor(1000 * mirror) / 10, 99.9)
        probability = f"right with a probability of at least {least:g} %"
        which = (
            f"one in which missing points are farther away, {probability} if the "
            "object hides them. If it does not, use --no-hidden-points."
        )
        if model["mirror_decided_by_perspective"]:
            which = f"one that fits perspective, {probability}"
        elif model["parameters"]["prior"] is not None:
            which = f"one of the prior, {probability}"
        parts.append(f"mirror image in depth: the {which}")
    meaning = model["camera_meaning"]
    return [*parts, _sentence(meaning)] if meaning else parts


def _perspective(model: dict[str, Any], unit: dict[str, Any] | None) -> list[str]:
    """Return comparison, focal length and unit of positions of perspective cameras."""
    focal, deviation = model["focal_length"], model["focal_length_std"]
    compared = [_sentence(model["perspective"])] if model["perspective"] else []
    if focal is None:
        return compared
    if not math.isfinite(focal):
        return ["no perspective: the focal length is too long to estimate it"]
    shown = "given"
    if model["parameters"]["focal_length"] is None:
        shown = f"estimated, standard deviation {deviation:.2g}"
    x, y = model["principal_point"]
    length = "in units of the shapes"
    if unit is not None:
        a, b = unit["points"]
        length = f"points {a} and {b} of the mean shape are {unit['length']:g} apart"
    return [
        f"focal length {focal:.4g} ({shown}), principal point ({x:g}, {y:g})",
        f"positions in cameras.csv: {length}",
        *compared,
    ]


def _alpha(model: dict[str, Any]) -> Section:
    """Return the distribution of the coefficients, and what the pose predicts."""
    coefficients = model["alpha"]
    shares = [row["pose_share"] for row in coefficients]
    rows = [
        [
            row["name"],
            f"{100 * row['energy_share']:.1f} %",
            *(f"{row[key]:z.2f}" for key in ("mean", "std", "min")),
            f"{row['row_of_min']}",
            f"{row['max']:z.2f}",
            f"{row['row_of_max']}",
            f"{100 * max(share, 0):.0f} %" if pd.notna(share) else "",
        ]
        for row, share in zip(coefficients, shares, strict=True)
    ]
    head = ["", "energy", "mean", "std", "min", "row", "max", "row", "pose"]
    is_posed = any(row[-1] for row in rows)
    head, *rows = [line[: len(head) - (not is_posed)] for line in (head, *rows)]
    parts: list[str | Cells] = [
        Cells(head, rows),
        "energy: share of the deformation in the images (sum of squares)",
    ]
    if is_posed:
        parts.append("pose: variance that yaw, pitch and roll predict, cross-validated")
    if model["parameters"]["remove_pose"]:
        most = max(coefficients, key=lambda row: row["pose_removed"] or 0.0)
        share = f"{100 * (most['pose_removed'] or 0.0):.0f} % of {most['name']}"
        parts.append(
            f"--remove-pose: what yaw predicts was removed, up to {share}. It assumes "
            "that the objects move alike in all views"
        )
    correlations = np.triu(np.nan_to_num(np.array(model["correlations"], float)), 1)
    if correlations.any():
        place = np.unravel_index(abs(correlations).argmax(), correlations.shape)
        first, second = (coefficients[k]["name"] for k in place)
        found = (
            f"largest correlation: {correlations[place]:.2f}, of {first} and {second}"
        )
        others = "; --independence coefficients lowers it"
        given, is_joint = model["parameters"], model["noise_variance"] is not None
        is_open = given["independence"] == "shapes" and given["prior"] is None
        parts.append(found + others * (is_joint and is_open))
    return parts


def _choice(choice: dict[str, Any]) -> Section:
    """Return the held-out error of each number of basis shapes."""
    tried, errors = choice["n_components"], choice["held_out_error"]
    deviations = choice["held_out_error_standard_error"]
    rows = [
        [
            f"{k}",
            f"{_digits(100 * error, 3)} %",
            f"{_digits(100 * deviation, 2)} %",
            "the least" * (k == choice["chosen"]),
        ]
        for k, error, deviation in zip(tried, errors, deviations, strict=True)
    ]
    cells = Cells(["K", "held-out error", "standard error", ""], rows)
    if min(errors) >= 1:
        # Other reports do not wait for scikit-learn's model selection.
        from isa_nrsfm._selection import NO_SHAPE

        return [cells, NO_SHAPE]
    parts: list[str | Cells] = [cells, "as under Fit, in frames left out of the fit"]
    if choice["larger_may_be_better"]:
        more = f"three more take at least {3 * choice['seconds'][-1]:.0f} s"
        parts.append(
            f"larger K may be better: this is the largest of those tried; {more}"
        )
    return parts


def _label(label: dict[str, Any]) -> Section:
    """Return how coefficients depend on a label."""
    title = f"{label['column']}: {label['n_frames']} frames"
    if "classes" in label:
        title += f" of {len(label['classes'])} classes"
    if label["n_copies"]:
        title += f"; {label['n_copies']} copies of other frames count once with them"
    if label["n_without_label"]:
        title += f"; {label['n_without_label']} without a label left out"
    names = names_of_components(None, len(label["values"]))
    statistic, meaning = STATISTICS[label["kind"]]
    found = zip(names, label["values"], label["p_values"], strict=True)
    rows = [
        [name, f"{value:z.2f}", "" if label["untested"] else f"{p:.3f}"]
        for name, value, p in found
    ]
    answer = f"{label['column']} was not tested: {label['untested']}."
    test = "no p-values"
    means: list[str] = []
    if not label["untested"]:
        related = np.asarray(names)[np.less(label["p_values"], 0.05)]
        coefficients = ", ".join(related) or "no coefficient"
        answer = f"{label['column']} goes with {coefficients} (p < 0.05)."
        test = f"corrected p-values: permutations of {label['permuted']}"
        if "class_means" in label and len(related):
            means = _class_means(label, names)
    return [
        answer,
        Cells(["", statistic, "p"], rows, title),
        f"{statistic}: {meaning}; {test}",
        *means,
        _score(label),
        *_many(label),
    ]


def _score(label: dict[str, Any]) -> str:
    """Return how well coefficients predict a label, compared with PCA."""
    if "not_cross_validated" in label:
        return f"not cross-validated: {label['not_cross_validated']}"
    classes = label["score"] == "accuracy"

    def shown(name: str) -> str:
        score, error = (label[name + each] for each in ("", "_standard_error"))
        if classes:
            return f"{100 * score:.1f} +- {100 * error:.1f} %"
        return f"{score:.2f} +- {error:.2f}"

    parts = [
        f"{'accuracy' if classes else 'R^2'} {shown('cross_validated')} (standard error"
        "); PCA of the aligned frames"
    ]
    for name in ("cross_validated_pca", "cross_validated_pca_of_rank"):
        parts.append(f"{shown(name)} ({label[f'{name}_n_features']} components)")
    if classes:
        parts.append(f"largest class {100 * label['largest_class']:.1f} %")
    return f"cross-validated {parts[0]} {', '.join(parts[1:])}"


def _many(label: dict[str, Any]) -> list[str]:
    """Return that classes have too many coefficients for their frames, if they have.

    From .4 coefficients a frame: docs/benchmarks/README.md, "Thresholds".
    """
    n_frames, n_components = label["n_frames"], len(label["values"])
    if label["score"] != "accuracy" or n_components < 0.4 * n_frames:
        return []
    return [
        f"{n_components} coefficients are many for {n_frames} frames: fewer predict "
        "classes better. Keep this fit for shapes and depths; for classes, fit again "
        f"without --prior, with -k {max(n_frames // 6, 1)} or less."
    ]


def _class_means(label: dict[str, Any], names: Sequence[str]) -> list[str]:
    """Return the means of the classes of significant coefficients, largest first."""
    lines = ["mean of each class if p < 0.05, in standard deviations:"]
    means = pd.DataFrame(label["class_means"], names)
    for name, row in means[np.less(label["p_values"], 0.05)].iterrows():
        largest = row.sort_values(key=lambda mean: -mean.abs(), kind="stable")
        listed = [f"{each} {mean:+z.1f}" for each, mean in largest.items()]
        rest = " (all in report.json)" * (len(listed) > MOST_CLASSES)
        lines.append(f"{name}: {first_items(listed, MOST_CLASSES)}{rest}.")
    return lines


def _groups(groups: dict[str, Any]) -> Section:
    """Return how much coefficients differ between groups."""
    column = groups["column"]
    if "not_divided" in groups:
        return [f"{column}: {groups['not_divided']}"]
    names = names_of_components(None, len(groups["between"]))
    shares = zip(names, groups["between"], groups["within"], strict=True)
    rows = [[name, f"{100 * a:.1f} %", f"{100 * b:.1f} %"] for name, a, b in shares]
    title = f"{column}: variance between and within {groups['n_groups']} groups"
    return [Cells(["", "between", "within"], rows, title)]


def _time(time: dict[str, Any]) -> Section:
    """Return the result of smoothing in time."""
    scales = np.asarray(time["time_scales"], dtype=float)
    name = time["column"]
    if (frames := time.get("frames")) is not None:
        name = f"frames {frames[0]:g} to {frames[1]:g} by {name or 'row'}"
    if not len(scales):
        return [f"{name}: no dynamics found, coefficients are not smoothed"]
    fading = scales[np.isfinite(scales)]
    found = []
    if len(fading):
        listed = first_items(f"{each:.3g}" for each in fading)
        found.append(f"changes of the shape fade within {listed} {time['unit']}")
    if lasting := len(scales) - len(fading):
        found.append(f"changes last in {lasting} of {len(scales)} directions")
    return [
        f"{name}: {'; '.join(found)}",
        f"smoothed coefficients differ by {time['changed_by']:.2f} (root mean square)",
    ]


def _shapes(model: dict[str, Any]) -> str:
    """Return how many basis shapes a model has."""
    n_components = model["n_components"]
    return f"{n_components} basis shape{'s' * (n_components != 1)}"


def _sentence(text: str) -> str:
    """Return a text as a sentence; names of files stay as they are."""
    if text.partition(" ")[0].isalpha():
        text = text[:1].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else f"{text}."


def _digits(number: float, n_digits: int) -> str:
    """Write a number with so many digits, zeros at the end included."""
    return f"{number:#.{n_digits}g}".removesuffix(".")
