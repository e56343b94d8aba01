"""
Time fits as ratios to an SVD in the same run, new frames, and starts; one BLAS thread.

Run ``python -m benchmarks.speed [section ...] [--pairs N]``. Each ratio is taken pair
by pair, reference and candidate in turn, so that it holds on a machine whose speed
drifts.
"""

import copy
import os
import resource
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from sklearn.utils.extmath import randomized_svd
from threadpoolctl import threadpool_limits

from benchmarks._run import run_isolated, run_sections
from benchmarks._sets import CASES, YOGA, load_table, measurement_matrix
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.baselines import BlockMatrixNRSfM
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.export import pose_function
from isa_nrsfm.io import save_model, write_table

# Frames that are timed one by one, half of them.
SINGLE = 100


def seconds(function, repeats=1):
    """Return the mean seconds of a call."""
    start = time.perf_counter()
    for _ in range(repeats):
        function()
    return (time.perf_counter() - start) / repeats


def process_seconds(arguments):
    """Return the seconds of processor time, user and system, of a run of Python."""

    def used():
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    before = used()
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *arguments]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
    return used() - before


def processor_seconds(function):
    """Return the seconds of processor time of a call."""
    start = time.process_time()
    function()
    return time.process_time() - start


def heading(rows, candidate, reference):
    """Print the heading of a table of ratios."""
    print(f"{rows:30}{'min':>8}{'median':>8}{'max':>8}{candidate:>10}{reference:>9}")


def compare(title, candidate, reference, n_pairs, against="", measure=seconds, per=1):
    """Print the ratios of a candidate to a reference, and milliseconds of one of both.

    Each is done so many times in a call, and measured in turn; the first call of each
    is not counted.
    """
    measure(candidate), measure(reference)
    pairs = [(measure(candidate), measure(reference)) for _ in range(n_pairs)]
    least, median, most = np.percentile([a / b for a, b in pairs], [0, 50, 100])
    own, other = 1e3 * np.median(pairs, axis=0) / per
    digits = 1 if per == 1 else 3
    print(
        f"{title:30}{least:8.2f}{median:8.2f}{most:8.2f}"
        f"{own:10.{digits}f}{other:9.{digits}f}  {against}".rstrip(),
        flush=True,
    )


def svd_of(X, scale_frames=True):
    """Return a function that takes the thin SVD of a table."""
    W, _ = measurement_matrix(X, scale_frames)
    return partial(np.linalg.svd, W, full_matrices=False)


def drawn(n_frames, n_points, n_components, **options):
    """Return a table with 2 % noise."""
    size = n_frames, n_points, n_components
    return make_nonrigid_tracks(*size, noise=0.02, random_state=0, **options).data


def fits(options):
    """Whole fits, relative to numpy.linalg.svd(W, full_matrices=False)."""
    for refinement in ("joint", "alternating"):
        heading(refinement, "fit ms", "SVD ms")
        for case in CASES:
            X = load_table(case)
            if X is None:
                continue
            settings = {"scale_frames": case.scale_frames, "random_state": 0}
            model = AffineNRSfM(case.n_components, refinement=refinement, **settings)
            svd = svd_of(X, case.scale_frames)
            compare(case.title, partial(model.fit, X), svd, options.pairs)


def large(options):
    """Fits of large tables: many frames, and many points with and without gaps."""
    heading("", "fit ms", "ms of")
    X, model = drawn(8000, 68, 9), AffineNRSfM(9, random_state=0)
    fit, svd = partial(model.fit, X), svd_of(X)
    compare("8000 x 68, K=9", fit, svd, options.pairs, "thin SVD")
    X, model = drawn(2500, 7308, 8), AffineNRSfM(8, random_state=0)
    W, _ = measurement_matrix(X)
    for dtype in (np.float64, np.float32):
        compare(
            f"2500 x 7308, {np.dtype(dtype)}",
            partial(model.fit, X.astype(dtype)),
            partial(randomized_svd, W.astype(dtype), 27, n_iter=4, random_state=0),
            options.pairs,
            "randomized_svd",
        )
    fit, other = partial(model.fit, with_holes(X, 0.05)), partial(model.fit, X)
    compare("5 % missing", fit, other, options.pairs, "complete")


def with_holes(X, share, seed=0):
    """Return a table with a share of its points missing at random."""
    tracks = X.reshape(len(X), -1, 2).astype(float)
    hidden = np.random.default_rng(seed).random(tracks.shape[:2]) < share
    return np.where(hidden[..., None], np.nan, tracks).reshape(X.shape)


def each(function, rows):
    """Call a function of each row."""
    for row in rows:
        function(row)


def live(options):
    """One frame: transform relative to small SVDs, pose and shape to transform.

    68 points, of which none or 20 % are missing, and 9 basis shapes. The SVDs are ten
    of matrices (68, 30). Seconds of processor time.
    """
    heading("", "ms", "ms of")
    matrix = np.random.default_rng(0).normal(size=(68, 30))
    svds = partial(each, np.linalg.svd, [matrix] * 20 * SINGLE)
    options = {
        "n_pairs": options.pairs,
        "measure": processor_seconds,
        "per": 2 * SINGLE,
    }
    for camera in ("affine", "weak_perspective"):
        X = drawn(1500, 68, 9, camera=camera)
        model = AffineNRSfM(9, camera=camera, random_state=0).fit(X[:1000])
        rows = [X[i : i + 1] for i in range(1000, 1000 + 2 * SINGLE)]
        holed = [with_holes(row, 0.2) for row in rows]
        pose = pose_function(model, edges=None)

        def everything(row, model=model, pose=pose):
            frame = model.decompose(row)
            return frame.alpha, model.reconstruct(frame), pose(frame)

        transform = partial(each, model.transform, rows)
        for title, candidate, reference, what in (
            ("transform", transform, svds, "ten SVDs"),
            (
                "20 % missing",
                partial(each, model.transform, holed),
                transform,
                "transform",
            ),
            ("pose and shape", partial(each, everything, rows), transform, "transform"),
        ):
            title = f"{camera[:9]:10}{title}"
            compare(title, candidate, reference, against=what, **options)


def write_long_table(path, n_frames):
    """Write a table of 68 points: copies of 100,000 frames, each with its own noise."""
    X = make_nonrigid_tracks(100_000, 68, n_components=9, random_state=0).data
    rng = np.random.default_rng(0)
    table = np.lib.format.open_memmap(path, "w+", shape=(n_frames, X.shape[1]))
    noise = 0.02 * X.std()
    for first in range(0, n_frames, len(X)):
        rows = table[first : first + len(X)]
        rows[:] = X[: len(rows)] + noise * rng.normal(size=(len(rows), X.shape[1]))


def fit_long_table(measured, path, how, n_jobs=1):
    """Fit a stored table, and compute the coefficients of all its frames."""
    with ExitStack() as stack:
        table = np.load(path, mmap_mode=None if how == "memory" else "r")
        if how == "dask":
            import dask.array
            import distributed
            from distributed.deploy.subprocess import SubprocessCluster

            cluster = SubprocessCluster(
                n_workers=2, threads_per_worker=1, dashboard_address=None
            )
            client = distributed.Client(stack.enter_context(cluster))
            stack.enter_context(client).wait_for_workers(2)
            read = partial(np.load, mmap_mode="r")
            rows = [slice(s, s + 50_000) for s in range(0, len(table), 50_000)]
            parts = [
                dask.array.from_delayed(
                    dask.delayed(lambda part: np.array(read(path)[part]))(part),
                    (min(part.stop, len(table)) - part.start, table.shape[1]),
                    table.dtype,
                )
                for part in rows
            ]
            table = dask.array.concatenate(parts)
        model = AffineNRSfM(9, random_state=0, keep_frames=False, n_jobs=n_jobs)
        with measured():
            alpha = model.fit(table).transform(table)
            if how == "dask":
                alpha.compute()
        return {"noise": model.noise_variance_}


def long(options):
    """Fit and transform of 100,000 and a million frames: in memory, from disk, on dask.

    Seconds, megabytes that the process of the fit took more, and the noise variance,
    which must be the same for all ways.
    """
    print(f"{'':28}{'s':>8}{'MB':>8}{'ratio':>8}  noise variance")
    ways = [("memory", 1), ("memory", 2), ("disk", 1), ("disk", 2), ("dask", 1)]
    with TemporaryDirectory() as folder:
        before = {}
        for n_frames in (100_000, 1_000_000):
            path = Path(folder, f"{n_frames}.npy")
            write_long_table(path, n_frames)
            for how, n_jobs in ways:
                arguments = {"path": path, "how": how, "n_jobs": n_jobs}
                found = run_isolated(fit_long_table, arguments, time_limit=1800)
                if found["status"] != "ok":
                    print(f"{n_frames:>9} {how}: {found['status']} {found['message']}")
                    continue
                seconds, noise = found["seconds"], found["values"]["noise"]
                ratio = seconds / before.setdefault((how, n_jobs), seconds)
                print(
                    f"{n_frames:>9} {how:8} {n_jobs} job(s) {seconds:8.1f}"
                    f"{found['memory']:8.0f}{ratio:8.2f}  {noise:.6g}",
                    flush=True,
                )


def start(options):
    """Processor time of whole commands, relative to Python and to what they import.

    The start of a command may take three times that of Python and 100 ms, and
    ``transform`` of one frame 1.2 times the import of scikit-learn and pandas.
    """
    heading("", "ms", "ms of")
    nothing = ["-c", "pass"]
    imports = ["-c", "import sklearn.decomposition, pandas"]
    package = ["-m", "isa_nrsfm"]
    with TemporaryDirectory() as folder:
        model, table, output = (
            str(Path(folder, name)) for name in ("faces.npz", "one.csv", "alpha.csv")
        )
        faces = make_face_tracks(400, n_components=3, random_state=0)
        X = pd.DataFrame(faces.data, columns=faces.feature_names)
        save_model(AffineNRSfM(3, random_state=0).fit(X), model)
        write_table(X.iloc[:1], table)
        transform = [*package, "transform", model, table, "--output", output, "--force"]
        for title, command, against, reference in (
            ("--version", [*package, "--version"], "python", nothing),
            ("--help", [*package, "--help"], "python", nothing),
            ("fit --help", [*package, "fit", "--help"], "python", nothing),
            ("transform, one frame", transform, "imports", imports),
        ):
            compare(title, command, reference, options.pairs, against, process_seconds)


def threads(options):
    """Two BLAS threads beside another program, relative to one."""
    X = drawn(2000, 68, 6)
    body = make_body_tracks(400, random_state=0).data
    model = AffineNRSfM(6, random_state=0).fit(X)

    def with_threads(number, function):
        with threadpool_limits(number, user_api="blas"):
            function()

    heading("", "two, ms", "one, ms")
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        try:
            for title, function in (
                ("fit", lambda: model.fit(X)),
                ("fit, 20 % missing", lambda: model.fit(with_holes(X, 0.2))),
                ("transform", lambda: model.transform(X)),
                ("BlockMatrixNRSfM", lambda: BlockMatrixNRSfM(4).fit(body)),
            ):
                compare(
                    title,
                    partial(with_threads, 2, function),
                    partial(with_threads, 1, function),
                    options.pairs,
                )
        finally:
            busy.kill()


def jobs(options):
    """Two jobs, relative to one."""
    heading("", "two, ms", "one, ms")
    X, dense = drawn(8000, 68, 9), drawn(2500, 7308, 8)
    long, model = np.tile(X, (40, 1)), AffineNRSfM(9, random_state=0)
    cases = [
        ("transform, 320,000 x 68", model.fit(X), "transform", long),
        ("fit, 320,000 x 68", model, "fit", long),
        ("fit, 2500 x 7308", AffineNRSfM(8, random_state=0), "fit", dense),
    ]
    yoga = load_table(YOGA)
    if yoga is not None:
        settings = {"camera": "orthographic", "refinement": "consensus"}
        body = AffineNRSfM("auto", random_state=0, **settings)
        cases.append(("consensus, yoga", body, "fit", yoga))
    for title, model, method, table in cases:
        one, two = (copy.copy(model).set_params(n_jobs=number) for number in (1, 2))
        compare(
            title,
            partial(getattr(two, method), table),
            partial(getattr(one, method), table),
            options.pairs,
        )


SECTIONS = {
    "start": start,
    "fits": fits,
    "large": large,
    "long": long,
    "live": live,
    "threads": threads,
    "jobs": jobs,
}

if __name__ == "__main__":
    pairs = {"type": int, "default": 5, "help": "pairs that are timed (default 5)"}
    run_sections(__doc__, SECTIONS, pairs=pairs)
