"""Sections reprojection and truth: fits of whole tables, and how good they are."""

import numpy as np

from benchmarks._figures import draw_bars
from benchmarks._methods import CALIBRATED, METHOD_TITLES, METHODS
from benchmarks._results import found, grid, number, remarks, select
from benchmarks._run import Section
from benchmarks._sets import SET_TITLES, SETS, load, shapes_in_camera
from isa_nrsfm.metrics import affine_shape_error, inverse_snr, mean_shape_error_3d

# Where in a table the frames are that pictures show.
SHOWN = (0.1, 0.35, 0.6, 0.85)
# What no method can be below.
BOUND = "floor"
# The joint refinement with each camera.
JOINT = ("joint", *CALIBRATED)
ERRORS = {
    "affine_shape_error": "`affine_shape_error`: one affinity of all frames, a scale "
    "of each, a share of the shapes' size",
    "frame_error": "`mean_shape_error_3d(convention='frame')`: a rotation and a scale "
    "of each frame, a share of the shapes' size",
    "sequence_error": "`mean_shape_error_3d(convention='sequence')`, shapes in the "
    "axes of their cameras: one rotation of all frames, in extents of the object",
}

TRUTH = """\
Take `camera="orthographic"` where the object is far away and all frames have one scale,
as in motion capture, and `camera="weak_perspective"` where each frame has a scale of
its own, as in photos of faces. Take `camera="affine"`, the default, where images may be
stretched, or where shapes up to an affinity of space are enough. Where nothing is
known, `diagnostics().camera_meaning` says whether calibrated cameras explain the table
as well as affine ones.

PI, BMM and Kong-Lucey presume orthographic cameras: of one scale or, where frames are
scaled, as large as the frame. Those of Shark, ICT-68, drink, pickup and yoga are just
that, and where rows are successive frames the methods are told so. The paper's
refinement has rigid cameras and "ISA, joint refinement" affine ones, which absorb part
of a deformation; both are calibrated after the fit (`isa_nrsfm.calibration`) for the
two errors that count angles. "ISA, weak perspective" and "ISA, orthographic" are the
joint refinement with these cameras, whose shapes are taken as they are. Orthographic
cameras are wrong for the synthetic tables, which have a scale in each frame. The flag
is seen in perspective, for which all are only nearly right. Where the cameras are
affine in truth, angles have no meaning, and calibrated cameras are wrong; where the
true shapes are in the space of the camera (Shark, flag), `affine_shape_error` has none.

What images hardly tell is a rotation that goes with the deformation. The errors that
count angles are therefore those in the axes of the cameras, where it makes no
difference whether the camera turned or the object, as in the literature.
`affine_shape_error` is of shapes in one space: on motion capture part of that of ISA is
such rotation. The true shapes, turned onto their mean, are 0.05 (ICT-68), 0.09 (drink)
and 0.10 (pickup, yoga) of their extents from where they were. With fewer basis shapes
than the object has, affine cameras absorb what is missing, on the shark with K=1 and
on the flag most. Bodies have more basis shapes than are taken here, as many as for the
paper; `python -m benchmarks.accuracy calibrated` has the errors with twelve.

Shapes are those that a method finds for the frames of its table. Median over the seeds
and, where they differ, range.
"""


def runs(sets, methods, repeats):
    """Return the fits of each set by each method, seed by seed, long ones first."""
    sets = sorted(sets, key=lambda name: SETS[name].most_repeats is None)
    return [
        (name, method, seed, {})
        for seed in range(repeats)
        for name in sets
        for method in methods
        if seed < runs_of(name, method, repeats)
    ]


def runs_of(name, method, repeats):
    """Return how many seeds a method takes on a set."""
    chosen = SETS[name]
    if not (METHODS[method].is_random or chosen.redrawn):
        return 1
    return min(repeats, chosen.most_repeats or repeats)


def measure_fit(measured, name, method, seed):
    """Fit a table, and judge what was found; some frames are shown in pictures."""
    chosen, kind = SETS[name], METHODS[method]
    table, K = load(name, seed), chosen.case.n_components
    X = table.X
    model = kind.make(chosen, K, seed)
    with measured():
        model.fit(X)
    result = kind.found(model, X)
    frames = (np.array(SHOWN) * len(X)).astype(int)
    return {
        "n_frames": len(X),
        "n_points": X.shape[1] // 2,
        "n_components": K,
        "inverse_snr": inverse_snr(X, result.X, scale_frames=chosen.case.scale_frames),
        "n_iter": getattr(model, "n_iter_", None),
        **truth_errors(name, seed, table, result),
        "shown": {
            "frames": frames,
            "observed": X[frames].reshape(len(frames), -1, 2),
            "reprojected": result.X[frames].reshape(len(frames), -1, 2),
        },
    }


def truth_errors(name, seed, table, result):
    """Return the errors in 3D of what was found, by name; none without a truth."""
    chosen, values = SETS[name], {}
    if not chosen.truth or result.affine is None:
        return values
    if chosen.truth == "object":
        values["affine_shape_error"] = affine_shape_error(table.shapes, result.affine)
    if chosen.camera != "affine":
        values |= errors_3d(chosen, shapes_in_camera(name, seed), result)
    return values


def errors_3d(chosen, truth, result):
    """
    Return the errors of Euclidean shapes, all in the axes of each frame's camera.

    There it makes no difference whether the camera or the object turned, which no
    image tells. Where images have the scale of the truth no scale is fitted for all
    frames.
    """
    unscaled = chosen.camera != "orthographic"
    shapes = result.in_camera(scaled=not unscaled)
    return {
        "sequence_error": mean_shape_error_3d(truth, shapes, scale=unscaled),
        "frame_error": mean_shape_error_3d(truth, shapes, convention="frame"),
    }


def reprojection_page(records):
    """Return the tables of the section reprojection."""
    titles = METHOD_TITLES, SET_TITLES
    return "\n".join(
        [
            "Inverse SNR in percent, lower is better: median over the seeds and, where "
            "they differ, range.\n",
            grid(records, *titles, "inverse_snr"),
            "Seconds of the fit.\n",
            grid(records, *titles, "seconds"),
            "Memory of the fit, MB: by how much memory in use rose at most.\n",
            grid(records, *titles, "memory", digits=2),
            not_lowest(records, {"inverse_snr": "inverse SNR"}),
            remarks(records, METHOD_TITLES),
        ]
    )


def truth_page(records):
    """Return the tables of the section truth."""
    titles, parts = (METHOD_TITLES, SET_TITLES), [TRUTH]
    judged = records[records["method"] != BOUND]
    for name, title in ERRORS.items():
        if name in records:
            has_it = judged[name].notna() | (judged["status"] != "ok")
            parts += [f"{title}. Lower is better.\n"]
            parts += [grid(judged[has_it], *titles, name)]
    measures = {"inverse_snr": "inverse SNR"} | {name: name for name in ERRORS}
    parts += [
        "Inverse SNR of the same fits in percent.\n",
        grid(records, *titles, "inverse_snr"),
        "Seconds of the fit.\n",
        grid(records, *titles, "seconds"),
        *(not_lowest(records, measures, method) for method in JOINT),
        remarks(records, METHOD_TITLES),
    ]
    return "\n".join(parts)


def not_lowest(records, measures, method="joint"):
    """
    Return a list of where a method is not the lowest by median, and what is.

    The joint refinement with other cameras does not count.
    """
    others = [m for m in METHODS if m == method or m not in (BOUND, *JOINT)]
    lines = []
    for name, title in SET_TITLES.items():
        of_set = select(records, set=name)
        for measure, measure_title in measures.items():
            medians = {
                other: float(np.median(values))
                for other in others
                if len(values := found(select(of_set, method=other), measure))
            }
            own = medians.get(method, -np.inf)
            if lower := [o for o in medians if medians[o] < own]:
                listed = ", ".join(
                    f"{METHOD_TITLES[o]} {number(medians[o])}" for o in lower
                )
                lines.append(
                    f"- {title}, {measure_title}: {number(own)}; lower are {listed}\n"
                )
    name = METHOD_TITLES[method]
    if select(records, method=method, status="ok").empty:
        return ""
    if not lines:
        return f"{name} is the lowest on every set here.\n"
    return f"{name} is not the lowest in\n\n{''.join(lines)}"


def draw_reprojection(records, folder):
    """Draw the inverse SNR, and return the name of the file."""
    file, label = "reprojection_errors.png", "inverse SNR, %"
    titles = METHOD_TITLES, SET_TITLES
    draw_bars(records, *titles, "inverse_snr", folder / file, label)
    return [file]


def draw_truth(records, folder):
    """Draw the errors in 3D, and return the names of the files."""
    titles = {name: t for name, t in METHOD_TITLES.items() if name != BOUND}
    files = []
    for name, text in ERRORS.items():
        if len(found(records, name)):
            files.append(f"truth_{name}.png")
            label = text.replace("`", "").partition(":")[0]
            label = f"{label}, {text.rpartition(', ')[2]}"
            path = folder / files[-1]
            draw_bars(records, titles, SET_TITLES, name, path, label, log=False)
    return files


REPROJECTION = Section(
    "Reprojection",
    measure_fit,
    reprojection_page,
    ("shark", "flag", "faces_wild", "ict_dense"),
    tuple(name for name in METHODS if name not in CALIBRATED),
    tuple(SETS),
    CALIBRATED,
    draw_reprojection,
    runs,
)
TRUTH_3D = Section(
    "3D truth",
    measure_fit,
    truth_page,
    tuple("shark flag ict_68 drink pickup yoga synthetic synthetic_affine".split()),
    tuple(name for name in METHODS if name != "consensus"),
    ("ict_dense", "drink_k11", "pickup_k11", "yoga_k9"),
    ("consensus",),
    draw_truth,
    runs,
)
