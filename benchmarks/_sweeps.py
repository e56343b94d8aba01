"""Sections recovery and cost: one setting of synthetic tables is varied at a time."""

import time

import numpy as np

from benchmarks._figures import draw_curves
from benchmarks._methods import METHOD_TITLES, METHODS
from benchmarks._results import found, grid, remarks, select, table
from benchmarks._run import Section
from benchmarks._sets import SETS, SYNTHETIC_NOISE, instance, measurement_matrix
from benchmarks.recovery import least_similarity
from isa_nrsfm.metrics import affine_shape_error

RECOVERY = {
    "n_points": (25, 40, 68, 150, 500),
    "n_components": (1, 2, 3, 5, 9),
    "noise": (0.0, 0.005, 0.01, 0.02, 0.05),
}
RECOVERY_BASE = {"n_points": 68, "n_components": 3, "noise": 0.02}
RECOVERY_AXES = {
    "n_points": "points",
    "n_components": "basis shapes K",
    "noise": "noise (share of the points' root mean square)",
}
# By name: what is said of it, and significant digits.
RECOVERY_MEASURES = {
    "similarity_modulo": (
        "Lowest `basis_similarity` of a basis shape, multiples of the mean shape left "
        "out; one is perfect.",
        4,
    ),
    "similarity": (
        "The same with the multiples of the mean shape, which images do not tell: "
        "below one for any method.",
        4,
    ),
    "affine_shape_error": ("`affine_shape_error` of the frames, lower is better.", 3),
}
COST = {
    "n_frames": (100, 300, 1000, 3000, 10_000, 30_000),
    "n_points": (23, 68, 200, 600, 2000, 6000),
    "n_components": (1, 2, 4, 8, 16),
}
COST_BASE = {"n_frames": 300, "n_points": 68, "n_components": 4}
COST_AXES = {
    "n_frames": "frames I",
    "n_points": "points J",
    "n_components": "basis shapes K",
}
SVD = "svd"
COST_TITLES = {name: METHOD_TITLES[name] for name in ("joint", "isa2")}
COST_TITLES[SVD] = "thin SVD of the same table"
COST_MEASURES = {"CPU seconds": "cpu_seconds", "peak memory, MB": "memory"}
# Short calls are repeated for so many seconds.
LEAST_SECONDS = 0.2
# Exponents are those of so many of the largest settings.
N_LARGEST = 3

COST_TEXT = """\
Tables of `make_nonrigid_tracks` with weak-perspective cameras and {noise:g} % noise, in
which one of I={n_frames}, J={n_points}, K={n_components} is varied; each fit has
a process of its own with one thread, and memory is what it takes beyond the table.
Exponents are slopes in log-log over the {n_largest} largest settings. Small tables cost
more than their size tells, because they are fitted from several starts, and large ones
less, because the first steps are taken on some of the frames.
"""


def runs_of(varied, base):
    """Return what returns the runs of all settings, each once."""

    def runs(sets, methods, repeats):
        settings = {
            tuple((base | {name: value}).items())
            for name, values in varied.items()
            for value in values
        }
        return [
            (name, method, seed, dict(setting))
            for seed in range(repeats)
            for name in sets
            for method in methods
            for setting in sorted(settings)
        ]

    return runs


def panels(records, base, axes):
    """Return by axis the name of a setting, and the records in which it varies."""
    return {
        axis: (
            name,
            select(records, **{o: base[o] for o in base if o != name}),
        )
        for name, axis in axes.items()
    }


def tables(panels, titles, measure, digits=3):
    """Return a table a setting, with a row a value and a column a method."""
    return [
        grid(
            records,
            {value: f"{value:g}" for value in sorted(records[name].unique())},
            titles,
            measure,
            row=name,
            column="method",
            corner=axis,
            digits=digits,
        )
        for axis, (name, records) in panels.items()
    ]


def measure_recovery(measured, name, method, seed, **setting):
    """Fit tracks of a known basis; the seed also says which."""
    tracks = instance(seed, **setting)
    model = METHODS[method].make(SETS[name], setting["n_components"], seed)
    with measured():
        model.fit(tracks.data)
    plain, modulo = least_similarity(tracks, model)
    shapes = METHODS[method].found(model, tracks.data).affine
    return {
        "similarity": plain,
        "similarity_modulo": modulo,
        "affine_shape_error": affine_shape_error(tracks.shapes, shapes),
    }


def recovery_page(records):
    """Return the tables of the section recovery."""
    parts = [
        "Tables of `make_nonrigid_tracks`; weak-perspective and affine cameras, 300 to "
        "500 frames and amplitudes of 15 to 20 %, by seed. Where nothing else is said "
        f"{RECOVERY_BASE['n_points']} points, K={RECOVERY_BASE['n_components']}, "
        f"{100 * RECOVERY_BASE['noise']:g} % noise. Median over the seeds and range.\n"
    ]
    varied = panels(records, RECOVERY_BASE, RECOVERY_AXES)
    for measure, (title, digits) in RECOVERY_MEASURES.items():
        parts += [title + "\n", *tables(varied, METHOD_TITLES, measure, digits)]
    return "\n".join([*parts, remarks(records, METHOD_TITLES)])


def draw_recovery(records, folder):
    """Draw the similarity of the basis shapes, and return the name of the file."""
    file = "recovery.png"
    measures = {"lowest similarity of a basis shape": "similarity_modulo"}
    varied = panels(records, RECOVERY_BASE, RECOVERY_AXES)
    draw_curves(varied, METHOD_TITLES, measures, folder / file)
    return [file]


def measure_cost(measured, name, method, seed, n_frames, n_points, n_components):
    """Fit tracks, or take the SVD of their measurement matrix, and count seconds."""
    X = instance(
        seed,
        n_points,
        n_components,
        SYNTHETIC_NOISE,
        n_frames=n_frames,
        camera="weak_perspective",
        amplitude=0.2,
    ).data
    if method == SVD:
        W, _ = measurement_matrix(X)
        return {"cpu_seconds": seconds_of_svd(measured, W)}
    model = METHODS[method].make(SETS[name], n_components, seed)
    with measured():
        since = time.process_time()
        model.fit(X)
        seconds = time.process_time() - since
    return {"cpu_seconds": seconds}


def seconds_of_svd(measured, W):
    """Return the mean seconds of a thin SVD."""
    n_times = 0
    with measured():
        since = time.process_time()
        while (seconds := time.process_time() - since) < LEAST_SECONDS:
            np.linalg.svd(W, full_matrices=False)
            n_times += 1
    return seconds / n_times


def exponent(name, records, measure):
    """Return the slope in log-log over the largest settings, if there are several."""
    points = [
        (setting, np.median(values))
        for setting, group in records.groupby(name)
        if len(values := found(group, measure))
    ]
    if len(points) < 2:
        return ""
    return f"{np.polyfit(*np.log(points[-N_LARGEST:]).T, 1)[0]:.2f}"


def cost_panels(records):
    """Return the panels of the section cost; the memory of an SVD is left out."""
    of_svd = records["method"] == SVD
    records = records.assign(memory=records["memory"].mask(of_svd))
    return panels(records, COST_BASE, COST_AXES)


def cost_page(records):
    """Return the tables of the section cost."""
    varied, noise = cost_panels(records), 100 * SYNTHETIC_NOISE
    parts = [COST_TEXT.format(noise=noise, n_largest=N_LARGEST, **COST_BASE)]
    for title, measure in COST_MEASURES.items():
        known = {
            name: heading
            for name, heading in COST_TITLES.items()
            if (records["method"] == name).any() and (name, measure) != (SVD, "memory")
        }
        rows = [
            [axis, *(exponent(n, select(r, method=m), measure) for m in known)]
            for axis, (n, r) in varied.items()
        ]
        parts += [f"## {title}\n", *tables(varied, known, measure)]
        parts.append(table(["exponent", *known.values()], rows))
    return "\n".join([*parts, remarks(records, COST_TITLES)])


def draw_cost(records, folder):
    """Draw seconds and memory, and return the name of the file."""
    file, varied = "cost.png", cost_panels(records)
    draw_curves(varied, COST_TITLES, COST_MEASURES, folder / file, log=True)
    return [file]


RECOVERED = Section(
    "Recovery of the basis",
    measure_recovery,
    recovery_page,
    ("synthetic",),
    ("isa1", "isa2", "joint"),
    other_methods=("pi", "bmm", "kong_lucey"),
    draw=draw_recovery,
    runs=runs_of(RECOVERY, RECOVERY_BASE),
)
COSTS = Section(
    "Cost of a fit",
    measure_cost,
    cost_page,
    ("synthetic",),
    ("joint", SVD),
    other_methods=("isa2",),
    draw=draw_cost,
    runs=runs_of(COST, COST_BASE),
)
