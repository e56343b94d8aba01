"""Section cost: seconds and memory of fits by frames, points and basis shapes."""

import time

import numpy as np

from benchmarks._figures import draw_curves
from benchmarks._jobs import Job
from benchmarks._markdown import found, remarks, select, table, value
from benchmarks._methods import METHOD_TITLES, METHODS
from benchmarks._sweep import Sweep
from benchmarks.recovery import instance
from benchmarks.speed import measured as measurement_matrix

SWEEP = Sweep(
    base={"n_frames": 300, "n_points": 68, "n_components": 4},
    varied={
        "n_frames": (100, 300, 1000, 3000, 10_000, 30_000),
        "n_points": (23, 68, 200, 600, 2000, 6000),
        "n_components": (1, 2, 4, 8, 16),
    },
    axes={
        "n_frames": "frames I",
        "n_points": "points J",
        "n_components": "basis shapes K",
    },
)
NOISE = 0.02
SVD = "svd"
TITLES = {name: METHOD_TITLES[name] for name in ("joint", "isa2")} | {
    SVD: "thin SVD of the same table"
}
MEASURES = {
    "CPU seconds": value("cpu_seconds"),
    "peak memory, MB": lambda record: None if record.method == SVD else record.memory,
}
# Short calls are repeated for so many seconds.
LEAST_SECONDS = 0.2
# Exponents are those of so many of the largest settings.
N_LARGEST = 3

TEXT = """\
Tables of `make_nonrigid_tracks` with weak-perspective cameras and {noise:g} % noise, in
which one of I={n_frames}, J={n_points}, K={n_components} is varied; each fit has
a process of its own with one thread, and memory is what it takes beyond the table.
Exponents are slopes in log-log over the {n_largest} largest settings. Small tables cost
more than their size tells, because they are fitted from several starts, and large ones
less, because the first steps are taken on some of the frames.
"""


def tracks(seed=0, **setting):
    """Return the tracks of a setting."""
    return instance(
        seed, noise=NOISE, camera="weak_perspective", amplitude=0.2, **setting
    )


def jobs(section, sets, methods, repeats):
    """Return a job for each setting, method and seed; the SVD takes one seed."""
    return [
        Job(
            section,
            name,
            method,
            seed,
            measure_cost,
            {"method": method, "seed": seed, **setting},
            setting,
        )
        for seed in range(repeats)
        for name in sets
        for setting in SWEEP.settings()
        for method in methods
        if method != SVD or seed == 0
    ]


def measure_cost(measured, method, seed, **setting):
    """Fit tracks, or take the SVD of their measurement matrix, and count seconds."""
    X = tracks(seed, **setting).data
    if method == SVD:
        W = measurement_matrix(X, True)
        return {"cpu_seconds": seconds_of_svd(measured, W)}, {}
    model = METHODS[method].make(setting["n_components"], True, False, seed)
    with measured():
        since = time.process_time()
        model.fit(X)
        seconds = time.process_time() - since
    return {"cpu_seconds": seconds}, {}


def seconds_of_svd(measured, W):
    """Return the mean seconds of a thin SVD."""
    n_times = 0
    with measured():
        since = time.process_time()
        while (seconds := time.process_time() - since) < LEAST_SECONDS:
            np.linalg.svd(W, full_matrices=False)
            n_times += 1
    return seconds / n_times


def exponent(settings, method, measure):
    """Return the slope in log-log over the largest settings, if there are several."""
    points = [
        (setting, np.median(values))
        for setting, records in settings.items()
        if (values := found(select(records, method=method), measure))
    ]
    if len(points) < 2:
        return ""
    return f"{np.polyfit(*np.log(sorted(points)[-N_LARGEST:]).T, 1)[0]:.2f}"


def page(records):
    """Return the tables of the section."""
    text = TEXT.format(noise=100 * NOISE, n_largest=N_LARGEST, **SWEEP.base)
    parts = [text]
    for title, measure in MEASURES.items():
        titles = {
            name: heading
            for name, heading in TITLES.items()
            if found(select(records, method=name), measure)
        }
        rows = [
            [axis, *(exponent(settings, name, measure) for name in titles)]
            for axis, settings in SWEEP.panels(records)
        ]
        parts.append(f"## {title}\n")
        parts += SWEEP.tables(records, titles, measure)
        parts.append(table(["exponent", *titles.values()], rows))
    return "\n".join([*parts, remarks(records, TITLES)])


def draw(records, folder):
    """Draw seconds and memory, and return the name of the file."""
    file = "cost.png"
    panels = SWEEP.panels(records)
    draw_curves(panels, TITLES, folder / file, measures=MEASURES, log=True)
    return [file]
