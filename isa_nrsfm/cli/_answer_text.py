"""What a fit says of labels, groups and times, as text for people."""

from typing import Any

import numpy as np

from isa_nrsfm.cli._outputs import component_names


def answer_lines(report: dict[str, Any]) -> dict[str, list[str]]:
    """Return the sections of the text for people."""
    sections = {}
    if "labels" in report:
        sections["Labels"] = [
            line for label in report["labels"] for line in _label_lines(label)
        ]
    if "groups" in report:
        sections["Groups"] = _group_lines(report["groups"])
    if "time" in report:
        sections["Time"] = _time_lines(report["time"])
    return sections


def _label_lines(label: dict[str, Any]) -> list[str]:
    """Say how coefficients go with a label."""
    names = component_names(len(label["values"]))
    without = label["n_without_label"]
    title = f"{label['column']}: {label['n_frames']} frames"
    if "classes" in label:
        title += f" of {len(label['classes'])} classes"
    if without:
        title += f"; {without} without it are left out"
    what = "eta squared" if label["statistic"] == "eta_squared" else "Spearman"
    lines = [title, f"{'':10} {what:>11} {'p':>6}"]
    lines += [
        f"{name:10} {value:z11.2f} {p:6.3f}"
        for name, value, p in zip(
            names, label["values"], label["p_values"], strict=True
        )
    ]
    if "not_cross_validated" in label:
        return [*lines, f"not cross-validated: {label['not_cross_validated']}"]
    ours, pca = label["cross_validated"], label["cross_validated_pca"]
    if label["score"] == "accuracy":
        lines.append(
            f"cross-validated accuracy {100 * ours:.1f} %; of PCA of the aligned "
            f"frames {100 * pca:.1f} %, of the largest class alone "
            f"{100 * label['largest_class']:.1f} %"
        )
    else:
        lines.append(
            f"cross-validated R^2 {ours:.2f}; of PCA of the aligned frames {pca:.2f}"
        )
    return lines


def _group_lines(groups: dict[str, Any]) -> list[str]:
    """Say how much coefficients differ between groups."""
    if "not_divided" in groups:
        return [f"{groups['column']}: {groups['not_divided']}"]
    names = component_names(len(groups["between"]))
    title = f"share of the variance between {groups['n_groups']} groups"
    return [
        f"{groups['column']}: {title}",
        *(
            f"{name:10} {100 * share:5.1f} %"
            for name, share in zip(names, groups["between"], strict=True)
        ),
    ]


def _time_lines(time: dict[str, Any]) -> list[str]:
    """Say what smoothing in time has found."""
    scales = np.asarray(time["time_scales"], dtype=float)
    if not len(scales):
        return [
            f"{time['column']}: the frames show no dynamics; coefficients are not "
            "smoothed"
        ]
    listed = ", ".join(
        f"{each:.3g}" if np.isfinite(each) else "never" for each in scales[:4]
    )
    return [
        f"{time['column']}: times until a shape is forgotten: {listed}"
        + (", ..." if len(scales) > 4 else ""),
        f"smoothed coefficients differ by {time['changed_by']:.2f}, root mean square",
    ]
