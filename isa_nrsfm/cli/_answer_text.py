"""What a fit says of labels, groups and times, as text for people."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from isa_nrsfm.cli._outputs import component_names

# Coefficients of which the means of classes are listed, and how many classes.
SIGNIFICANT, MOST_CLASSES = 0.05, 4


class Block(NamedTuple):
    """
    The answer of one column.

    Attributes
    ----------
    title : str
        What it is about.
    head : sequence of str
        Titles of the columns of the table.
    rows : sequence of sequence of str
        The table, a row for each coefficient.
    remarks : sequence of str
        What else is to be said.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    remarks: Sequence[str]


def answer_tables(report: dict[str, Any]) -> dict[str, list[Block]]:
    """Return the answers of a report by section."""
    sections = {}
    if "labels" in report:
        sections["Labels"] = [_label_block(label) for label in report["labels"]]
    if "groups" in report:
        sections["Groups"] = [_group_block(report["groups"])]
    if "time" in report:
        sections["Time"] = [_time_block(report["time"])]
    return sections


def answer_lines(report: dict[str, Any]) -> dict[str, list[str]]:
    """Return the answers as lines of text, by section."""
    return {
        section: [line for block in blocks for line in _lines(block)]
        for section, blocks in answer_tables(report).items()
    }


def _lines(block: Block) -> list[str]:
    """Lay a block out."""
    lines = [block.title]
    if block.rows:
        cells = [block.head, *block.rows]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines += [
            "  ".join(
                cell.rjust(width) if column else cell.ljust(width)
                for column, (cell, width) in enumerate(zip(row, widths, strict=True))
            )
            for row in cells
        ]
    return [*lines, *block.remarks]


def _label_block(label: dict[str, Any]) -> Block:
    """Say how coefficients go with a label."""
    names = component_names(len(label["values"]))
    title = f"{label['column']}: {label['n_frames']} frames"
    if "classes" in label:
        title += f" of {len(label['classes'])} classes"
    if label["n_without_label"]:
        title += f"; {label['n_without_label']} without it are left out"
    what = "eta squared" if label["statistic"] == "eta_squared" else "Spearman"
    rows = [
        [name, f"{value:z.2f}", f"{p:.3f}"]
        for name, value, p in zip(
            names, label["values"], label["p_values"], strict=True
        )
    ]
    permuted = f"p-values: permutations of {label['permuted']}"
    return Block(
        title, ["", what, "p"], rows, [permuted, *_class_lines(label), _told(label)]
    )


def _class_lines(label: dict[str, Any]) -> list[str]:
    """Say at which end of its coefficients each class is."""
    classes = label.get("class_means", {})
    names = component_names(len(label["values"]))
    lines = []
    for k, (name, p) in enumerate(zip(names, label["p_values"], strict=True)):
        if p < SIGNIFICANT and classes:
            means = {each: mean[k] for each, mean in classes.items()}
            order = sorted(means, key=lambda each: -abs(means[each]))[:MOST_CLASSES]
            shown = ", ".join(f"{each} {means[each]:+.1f}" for each in order)
            lines.append(f"{name}: {shown}" + ", ..." * (len(means) > MOST_CLASSES))
    if lines:
        head = (
            "mean of each class where p < 0.05, in standard deviations; + is the + end"
        )
        lines.insert(0, f"{head} of the basis shape")
    return lines


def _told(label: dict[str, Any]) -> str:
    """Say how well all coefficients together tell a label."""
    if "not_cross_validated" in label:
        return f"not cross-validated: {label['not_cross_validated']}"
    ours, pca = label["cross_validated"], label["cross_validated_pca"]
    if label["score"] == "accuracy":
        return (
            f"cross-validated accuracy {100 * ours:.1f} %; of PCA of the aligned "
            f"frames {100 * pca:.1f} %, of the largest class alone "
            f"{100 * label['largest_class']:.1f} %"
        )
    return f"cross-validated R^2 {ours:.2f}; of PCA of the aligned frames {pca:.2f}"


def _group_block(groups: dict[str, Any]) -> Block:
    """Say how much coefficients differ between groups."""
    if "not_divided" in groups:
        return Block(f"{groups['column']}: {groups['not_divided']}", [], [], [])
    names = component_names(len(groups["between"]))
    rows = [
        [name, f"{100 * between:.1f} %", f"{100 * within:.1f} %"]
        for name, between, within in zip(
            names, groups["between"], groups["within"], strict=True
        )
    ]
    title = f"{groups['column']}: variance between and within {groups['n_groups']}"
    return Block(f"{title} groups", ["", "between", "within"], rows, [])


def _time_block(time: dict[str, Any]) -> Block:
    """Say what smoothing in time has found."""
    scales = np.asarray(time["time_scales"], dtype=float)
    if not len(scales):
        title = "the frames show no dynamics; coefficients are not smoothed"
        return Block(f"{time['column']}: {title}", [], [], [])
    lasting, fading = int(np.isinf(scales).sum()), scales[np.isfinite(scales)]
    said = []
    if len(fading):
        listed = ", ".join(f"{each:.3g}" for each in fading[:4])
        more = ", ..." if len(fading) > 4 else ""
        said.append(f"a change of the shape fades within {listed}{more}")
    if lasting:
        said.append(f"in {lasting} of {len(scales)} directions of change it lasts")
    changed = f"smoothed coefficients differ by {time['changed_by']:.2f}, "
    return Block(
        f"{time['column']}: {'; '.join(said)}",
        [],
        [],
        [f"{changed}root mean square"],
    )
