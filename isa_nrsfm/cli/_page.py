"""The report of a fit as one page that any browser shows, without a script."""

import base64
import shlex
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from isa_nrsfm._compat.whole_files import write_whole
from isa_nrsfm.cli._answer_text import answer_tables
from isa_nrsfm.cli._parser import PROGRAM
from isa_nrsfm.cli._report import camera_text, fit_sections, fit_title, pose_cell

REPORT_PAGE = "report.html"


def write_report_page(folder: Path, report: dict[str, Any]) -> None:
    """
    Write the report of a fit as a page, with the figures of the folder in it.

    All texts of the table, such as names of columns, stay text.
    """
    parts = [
        f"<h1>{escape(fit_title(report))}</h1>",
        _paragraph(f"{report['table']['path']}, {report['finished']}", "quiet"),
        *_advice(report),
        *_figures(folder, report["files"]),
        *_choice(report),
        *_coefficients(report["model"]),
        *answer_sections(report),
        *_details(report),
    ]
    template = (files("isa_nrsfm.cli") / REPORT_PAGE).read_text(encoding="utf-8")
    page = template.replace("{{title}}", escape(fit_title(report)))
    write_whole(
        folder / REPORT_PAGE,
        page.replace("{{content}}", "\n".join(parts)).encode(errors="replace"),
    )


def _advice(report: dict[str, Any]) -> list[str]:
    """Say in words how good the fit is, and what to do about what is not."""
    model = report["model"]
    lines = [
        "Points that are predicted from the other points of their frame are off by "
        f"{_percent(model['held_out_error'])} of its energy, points that are fitted "
        f"by {_percent(model['inverse_snr'])}. Too many basis shapes make the first "
        "much larger than the second. Both are frames to which the shapes were fitted."
    ]
    if cameras := camera_text(model):
        lines.append(_sentence(cameras))
    return [
        "<h2>What it says</h2>",
        *(_paragraph(line) for line in lines),
        *(_paragraph(_sentence(each), "advice") for each in report["warnings"]),
    ]


def _figures(folder: Path, listed: dict[str, str]) -> list[str]:
    """Return the figures of a folder with their captions."""
    names = [name for name in listed if name.endswith(".png")]
    parts = ["<h2>Figures</h2>"] if names else []
    for name in names:
        image = base64.b64encode((folder / name).read_bytes()).decode()
        caption = escape(listed[name])
        parts.append(
            f'<figure><img src="data:image/png;base64,{image}" alt="{caption}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    return parts


def _choice(report: dict[str, Any]) -> list[str]:
    """Return the section of the choice of K, where there was one."""
    lines = fit_sections(report).get("Choice")
    if not lines:
        return []
    return ["<h2>Choice of K</h2>", f"<pre>{escape(chr(10).join(lines))}</pre>"]


def _coefficients(model: dict[str, Any]) -> list[str]:
    """Return the table of the coefficients."""
    rows = [
        [
            row["name"],
            f"{100 * row['energy_share']:.1f} %",
            *(f"{row[key]:z.2f}" for key in ("mean", "std", "min", "max")),
            pose_cell(row),
        ]
        for row in model["alpha"]
    ]
    head = ["", "energy", "mean", "std", "min", "max", "pose"]
    meaning = "Pose: variance that yaw, pitch and roll predict, cross-validated."
    return ["<h2>Coefficients</h2>", table(head, rows), _paragraph(meaning, "quiet")]


def answer_sections(report: dict[str, Any]) -> list[str]:
    """Return the sections of labels, groups and times."""
    parts = []
    for title, blocks in answer_tables(report).items():
        parts.append(f"<h2>{escape(title)}</h2>")
        for block in blocks:
            parts.append(f"<h3>{escape(block.title)}</h3>")
            if block.rows:
                parts.append(table(block.head, block.rows))
            parts += map(_paragraph, block.remarks)
    return parts


def _details(report: dict[str, Any]) -> list[str]:
    """Return what the table had, the command, the files and the versions."""
    sections = fit_sections(report)
    versions = ", ".join(f"{name} {v}" for name, v in report["versions"].items())
    parts = ["<h2>Table</h2>", _list(sections["Table"])]
    if "arguments" in report:
        command = shlex.join([PROGRAM, *report["arguments"]])
        parts += ["<h2>Command</h2>", f"<pre>{escape(command)}</pre>"]
    described = (f"{name}: {content}" for name, content in report["files"].items())
    return [
        *parts,
        _paragraph(versions, "quiet"),
        "<h2>Files beside this page</h2>",
        _list(described),
    ]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table, whose cells stay text."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><tr>{top}</tr>{body}</table></div>'


def _list(lines: Iterable[str]) -> str:
    """Return a list of texts."""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph of a text."""
    attribute = f' class="{kind}"' if kind else ""
    return f"<p{attribute}>{escape(text)}</p>"


def _sentence(text: str) -> str:
    """Return a text that begins and ends as a sentence does; names stay as they are."""
    if text.partition(" ")[0].isalpha():
        text = text[:1].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else f"{text}."


def _percent(fraction: float) -> str:
    """Write a fraction in percent."""
    return f"{100 * fraction:.3g} %"
