"""Sections reprojection and truth: fits of whole tables, and how good they are."""

import numpy as np

from benchmarks._methods import CALIBRATED, METHOD_TITLES, METHODS
from benchmarks._results import grid, remarks
from benchmarks._run import Section
from benchmarks._sets import SET_TITLES, SETS, load, shapes_in_camera
from isa_nrsfm.metrics import affine_shape_error, inverse_snr, mean_shape_error_3d

# Where in a table the frames are that pictures show.
SHOWN = (0.1, 0.35, 0.6, 0.85)
# What no method can be below.
BOUND = "floor"
ERRORS = {
    "affine_shape_error": "`affine_shape_error`: one affinity of all frames, a scale "
    "of each, a share of the shapes' size",
    "frame_error": "`mean_shape_error_3d(convention='frame')`: a rotation and a scale "
    "of each frame, a share of the shapes' size",
    "sequence_error": "`mean_shape_error_3d(convention='sequence')`, shapes in the "
    "axes of their cameras: one rotation of all frames, in extents of the object",
}

TRUTH = """\
How far are the reconstructed 3D shapes from the true ones? On these tables the true
shapes are known: they are rendered (ICT-68, shark, synthetic) or captured in 3D (flag,
drink, pickup, yoga). Each method sees only the 2D points. Errors are shares of the size
of the object: 0.03 is three percent. The first table ignores angles and proportions,
the other two count them. All methods were run here.

Which camera? Take `camera="weak_perspective"` for photos and videos, where each frame
has a scale of its own. Take `camera="orthographic"` if all frames have one scale, as in
motion capture, and `camera="affine"` if images may be stretched.
`diagnostics().camera_meaning` says whether the table agrees.

PI, BMM and Kong-Lucey assume orthographic cameras. Those of shark, ICT-68, drink,
pickup and yoga are orthographic, and the methods are told if rows are successive
frames. They and "ISA, joint refinement", with affine cameras, have K basis shapes.
Weak-perspective and orthographic fits have all directions of deformation that the table
supports, whatever K is: these are the shapes of `reconstruct`. Affine cameras absorb
part of a deformation, most with too few basis shapes (shark, flag); the paper's
refinement has rigid ones. Both are calibrated after the fit (`isa_nrsfm.calibration`)
for the errors that count angles. Orthographic cameras are wrong for the synthetic
tables, and the flag is seen in perspective. With affine true cameras, angles have no
meaning; if true shapes are in the axes of the camera (shark, flag), there is no
`affine_shape_error`.

Images do not determine a rotation that goes with the deformation. Errors that count
angles are therefore measured in the axes of the cameras, as in the literature. In
`affine_shape_error`, such rotations count: true shapes turned onto their mean move by
0.05 (ICT-68), 0.09 (drink) and 0.10 (pickup, yoga) of their extents.

Numbers are medians over the seeds and, if they differ, ranges.
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
    parts += [
        "Inverse SNR of the same fits in percent. The floor is that of rank 3K + 3.\n",
        grid(records, *titles, "inverse_snr"),
        "Seconds of the fit.\n",
        grid(records, *titles, "seconds"),
        remarks(records, METHOD_TITLES),
    ]
    return "\n".join(parts)


REPROJECTION = Section(
    "Reprojection",
    measure_fit,
    reprojection_page,
    ("shark", "flag", "faces_wild", "ict_dense"),
    tuple(name for name in METHODS if name not in CALIBRATED),
    tuple(SETS),
    CALIBRATED,
    runs=runs,
)
TRUTH_3D = Section(
    "3D truth",
    measure_fit,
    truth_page,
    tuple("shark flag ict_68 drink pickup yoga synthetic synthetic_affine".split()),
    tuple(name for name in METHODS if name != "consensus"),
    ("ict_dense", "drink_k11", "pickup_k11", "yoga_k9"),
    ("consensus",),
    runs=runs,
)
