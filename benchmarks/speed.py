"""
Time fits as ratios to an SVD in the same run, new frames, and starts; one BLAS thread.

Run ``python -m benchmarks.speed [section ...] [--seeds N] [--pairs N]``. Each ratio is
taken pair by pair, reference and candidate in turn, so that it holds on a machine whose
speed drifts.
"""

import copy
import gc
import os
import resource
import subprocess
import sys
import time
import tracemalloc
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from sklearn.utils.extmath import randomized_svd
from threadpoolctl import threadpool_limits

from benchmarks._command import run
from benchmarks._data import CASES, DRINK, FACES, MUCT, YOGA, halves_of, load_table
from benchmarks._isolated import run_isolated
from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm._estimator import frames_of
from isa_nrsfm._frames.models import frame_search
from isa_nrsfm._paper.factors import factorise
from isa_nrsfm._tables.tracks import (
    centred_tracks,
    measurement_matrix,
    table_to_tracks,
    weighting_sizes,
)
from isa_nrsfm.baselines import BlockMatrixNRSfM
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.export import pose_function
from isa_nrsfm.io import save_model, write_table

# Random starts against which the fit of a frame is held, and how far they are spread,
# in standard deviations of the coefficients.
N_STARTS = 20
SPREAD = 1.5
# A start finds something better if it lowers the objective by this share.
BETTER = 1e-6
# Section frames: new frames, how many are taken one by one to time one, frames of a
# stream, and the least number of pairs.
N_FRAMES, SINGLE, STREAM, FRAME_PAIRS = 8000, 100, 10_000, 10


def seconds(function, repeats=1):
    """Return the mean seconds of a call."""
    start = time.perf_counter()
    for _ in range(repeats):
        function()
    return (time.perf_counter() - start) / repeats


def processor_seconds(function, repeats=1):
    """Return the mean seconds of processor time of a call."""
    start = time.process_time()
    for _ in range(repeats):
        function()
    return (time.process_time() - start) / repeats


def process_seconds(arguments, repeats=1):
    """Return mean seconds of processor time, user and system, of runs of Python."""

    def used():
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    before = used()
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *arguments]
    for _ in range(repeats):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
    return (used() - before) / repeats


def paired_ratio(candidate, reference, n_pairs, repeats=1, measure=seconds):
    """Return ratios candidate / reference: minimum, median, maximum; and seconds."""
    measure(candidate), measure(reference)  # not counted
    pairs = [(measure(candidate), measure(reference, repeats)) for _ in range(n_pairs)]
    ratios = [a / b for a, b in pairs]
    return (*np.percentile(ratios, [0, 50, 100]), *np.median(pairs, axis=0))


def measured(X, scale_frames):
    """Return the measurement matrix of a table, as the fit sees it."""
    centred, _ = centred_tracks(table_to_tracks(X))
    sizes = weighting_sizes(centred, scale_frames)
    return measurement_matrix(centred / sizes[:, None, None])


def heading(rows, candidate, reference):
    """Print the heading of a table of ratios."""
    print(f"{rows:30}{'min':>8}{'median':>8}{'max':>8}{candidate:>10}{reference:>9}")


def compare(title, candidate, reference, n_pairs, against="", measure=seconds):
    """Print the ratios of a candidate to a reference, and their milliseconds."""
    least, median, most, own, other = paired_ratio(
        candidate, reference, n_pairs, measure=measure
    )
    print(
        f"{title:30}{least:8.2f}{median:8.2f}{most:8.2f}"
        f"{1e3 * own:10.1f}{1e3 * other:9.1f}  {against}".rstrip(),
        flush=True,
    )


def fits(options):
    """Whole fits, relative to numpy.linalg.svd(W, full_matrices=False)."""
    for refinement in ("joint", "alternating"):
        heading(refinement, "fit ms", "SVD ms")
        for case in CASES:
            X = load_table(case)
            if X is None:
                continue
            W = measured(X, case.scale_frames)
            model = AffineNRSfM(
                case.n_components,
                refinement=refinement,
                scale_frames=case.scale_frames,
                random_state=0,
            )
            compare(
                case.title,
                lambda model=model, X=X: model.fit(X),
                lambda W=W: np.linalg.svd(W, full_matrices=False),
                options.pairs,
            )


def large(options):
    """Fits of large tables: many frames, and many points with and without gaps."""
    heading("", "fit ms", "ms of")
    X = make_nonrigid_tracks(8000, 68, n_components=9, noise=0.02, random_state=0).data
    W, model = measured(X, True), AffineNRSfM(9, random_state=0)
    compare(
        "8000 x 68, K=9",
        partial(model.fit, X),
        partial(np.linalg.svd, W, full_matrices=False),
        options.pairs,
        "thin SVD",
    )
    X = make_nonrigid_tracks(
        2500, 7308, n_components=8, noise=0.02, random_state=0
    ).data
    W, model = measured(X, True), AffineNRSfM(8, random_state=0)
    for dtype in (np.float64, np.float32):
        compare(
            f"2500 x 7308, {np.dtype(dtype)}",
            partial(model.fit, X.astype(dtype)),
            partial(randomized_svd, W.astype(dtype), 27, n_iter=4, random_state=0),
            options.pairs,
            "randomized_svd",
        )
    compare(
        "5 % missing",
        partial(model.fit, with_holes(X, 0.05)),
        partial(model.fit, X),
        options.pairs,
        "complete",
    )


def with_holes(X, share, seed=0):
    """Return a table with a share of its points missing at random."""
    tracks = X.reshape(len(X), -1, 2).astype(float)
    hidden = np.random.default_rng(seed).random(tracks.shape[:2]) < share
    return np.where(hidden[..., None], np.nan, tracks).reshape(X.shape)


def half_fitted(case, seed=0):
    """Return a fit of half of the frames of a table and the other half, or None."""
    X = load_table(case)
    if X is None:
        return None
    train, test = halves_of(len(X), seed)
    model = AffineNRSfM(case.n_components, random_state=seed).fit(X[train])
    return model, X[test]


def frames_per_second(model, X, n_times):
    """Return the most frames a second of some calls of transform."""
    return len(X) / min(seconds(lambda: model.transform(X)) for _ in range(n_times))


def seconds_of_a_frame(model, X):
    """Return the median seconds of transform for single frames."""
    rows = (X[i : i + 1] for i in range(100))
    return np.median([seconds(partial(model.transform, row)) for row in rows])


def each(function, rows):
    """Call a function of each row."""
    for row in rows:
        function(row)


def heap_after_stream(model, X, n_frames):
    """Return the growth and the peak, in bytes, of the heap over single frames."""

    def stream(n_frames):
        for i in range(n_frames):
            model.transform(X[i % len(X)][None])
        gc.collect()

    tracemalloc.start()
    stream(100)  # whatever is made once
    before, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    stream(n_frames)
    after, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return after - before, peak - before


def frames(options):
    """New frames, many and one by one, relative to a thin SVD; memory of a stream.

    The frames have 68 points, and the model 9 basis shapes. The SVD is that of all
    complete frames. Milliseconds of single frames are those of all of them. Two jobs
    are held against one.
    """
    n_pairs = max(options.pairs, FRAME_PAIRS)

    heading(f"{N_FRAMES}", "ms", "ms of")
    for camera in ("weak_perspective", "affine"):
        X = make_nonrigid_tracks(
            N_FRAMES, 68, n_components=9, noise=0.02, camera=camera, random_state=0
        ).data
        tables = {"complete": X, "20 % missing": with_holes(X, 0.2)}
        model = AffineNRSfM(9, camera=camera, random_state=0).fit(X[:3000])
        two = copy.copy(model).set_params(n_jobs=2)
        svd = partial(np.linalg.svd, measured(X, True), full_matrices=False)
        for title, table in tables.items():
            title, transform = f"{camera[:6]} {title}", partial(model.transform, table)
            compare(title, transform, svd, n_pairs, "SVD")
            other = partial(two.transform, table)
            compare(f"{title}, 2 jobs", other, transform, n_pairs, "1 job")
    for title, table in tables.items():
        rows = [table[i : i + 1] for i in range(SINGLE)]
        singles = partial(each, model.transform, rows)
        compare(f"{SINGLE} single, {title}", singles, svd, n_pairs, "SVD")
    growth, peak = heap_after_stream(model, tables["20 % missing"], STREAM)
    print(
        f"stream of {STREAM} frames: {growth} bytes kept, {peak / 1e3:.0f} kB at most"
    )


def live(options):
    """One complete frame, relative to the search without checks, and to transform.

    68 points and 9 basis shapes. The search in plain NumPy includes centre, scale and
    change to the public coefficients. Seconds of processor time, for 200 frames.
    """
    heading("", "ms", "ms of")
    for camera in ("affine", "weak_perspective"):
        X = make_nonrigid_tracks(
            1500, 68, n_components=9, noise=0.02, camera=camera, random_state=0
        ).data
        model = AffineNRSfM(9, camera=camera, random_state=0).fit(X[:1000])
        rows = [X[i : i + 1] for i in range(1000, 1000 + 2 * SINGLE)]
        frames, pose = frames_of(model), pose_function(model, edges=None)
        alone, mixing = frames.single_search, frames.gauge.mixing

        def bare(row, alone=alone, mixing=mixing, noise=frames.noise_variance):
            points = row.reshape(-1, 2)
            points = points - points.mean(axis=0)
            size = np.sqrt(np.vdot(points, points) / points.size)
            fit = alone.fit(points.T / size, noise, np.inf)
            mixed = mixing @ np.append(1.0, fit.alpha)
            return mixed[1:] / mixed[0]

        def everything(row, model=model, pose=pose):
            frame = model.decompose(row)
            return frame.alpha, model.reconstruct(frame), pose(frame)

        transform = partial(each, model.transform, rows)
        for title, candidate, reference, what in (
            ("transform", transform, partial(each, bare, rows), "bare"),
            ("pose and shape", partial(each, everything, rows), transform, "transform"),
        ):
            least, median, most, own, other = paired_ratio(
                candidate, reference, options.pairs, measure=processor_seconds
            )
            own, other = 1e3 * own / len(rows), 1e3 * other / len(rows)
            print(
                f"{camera[:9]:10}{title:16}{least:4.2f}{median:8.2f}{most:8.2f}"
                f"{own:10.2f}{other:9.2f}  {what}",
                flush=True,
            )


def new_frames(options):
    """Frames a second of transform for frames that were not in the fit."""
    print(
        f"{'':22}{'complete':>10}{'20 % missing':>14}{'one frame, ms':>15}{'holed':>8}"
    )
    for case in (FACES, MUCT, DRINK, YOGA):
        fitted = half_fitted(case)
        if fitted is None:
            continue
        model, X = fitted
        holes = with_holes(X, 0.2)
        model.transform(X), model.transform(holes)  # not counted
        whole, holed = (
            frames_per_second(model, table, options.pairs) for table in (X, holes)
        )
        single, some = (seconds_of_a_frame(model, table) for table in (X, holes))
        print(
            f"{case.title:22}{whole:10.0f}{holed:14.0f}{1e3 * single:15.2f}"
            f"{1e3 * some:8.2f}",
            flush=True,
        )


def found_by_search(model, tracks, seed):
    """
    Return the objective of frames in their fit, and the least from random starts.

    Both are in units of the noise variance: minus twice the log posterior.
    """
    frames = frames_of(model)
    fit = frames.posterior(tracks.transpose(0, 2, 1)).objective
    found = np.full(len(tracks), np.inf)
    rng = np.random.default_rng(seed)
    for _ in range(N_STARTS):
        alpha = SPREAD * rng.normal(size=(len(tracks), model.n_components))
        search = frame_search("affine", frames.shapes)
        other = search.fit_rows(
            tracks.transpose(0, 2, 1), frames.noise_variance, initial=alpha
        )
        found = np.minimum(found, other.objective)
    return fit / frames.noise_variance, found / frames.noise_variance


def optima(options):
    """Share of new frames where 20 random starts find no better fit than transform."""
    print(f"{'':34}{'frames':>8}{'share %':>9}{'largest gain':>14}")
    for case in (FACES, MUCT, DRINK, YOGA):
        for seed in range(options.seeds):
            fitted = half_fitted(case, seed)
            if fitted is None:
                break
            model, X = fitted
            X = X[:1000]
            for share in (0.0, 0.2, 0.4):
                tracks = with_holes(X, share, seed).reshape(len(X), -1, 2)
                centred, _ = centred_tracks(tracks)
                unit = centred / weighting_sizes(centred, True)[:, None, None]
                fit, found = found_by_search(model, unit, seed)
                best = found >= fit - BETTER * np.abs(fit)
                print(
                    f"{case.title:16}{100 * share:4.0f} % missing    {len(X):8}"
                    f"{100 * best.mean():9.2f}{np.max(fit - found):14.3g}",
                    flush=True,
                )


def fastisa_iteration(options):
    """FastISA, 68 x 27: a step of one start, relative to an SVD of a 27 x 27 matrix."""
    heading("signals", "step us", "SVD us")
    random = np.random.default_rng(0)
    matrix = random.normal(size=(27, 27))
    tables = {"Laplace, artificial": random.laplace(size=(68, 27))}
    for case in CASES:
        if case.n_components == 9 and (X := load_table(case)) is not None:
            tables[case.title] = factorise(measured(X, True), 9).signals.T
    for title, signals in tables.items():
        isa = FastISA(random_state=0)
        steps = isa.fit(signals).n_iters_.sum()
        least, median, most, fit, svd = paired_ratio(
            lambda isa=isa, signals=signals: isa.fit(signals),
            lambda: np.linalg.svd(matrix),
            options.pairs,
            repeats=2000,
        )
        print(
            f"{title:22}{least / steps:8.2f}{median / steps:8.2f}{most / steps:8.2f}"
            f"{1e6 * fit / steps:10.1f}{1e6 * svd:9.1f}"
        )


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
            model.fit(table)
            alpha = model.transform(table)
            if how == "dask":
                alpha = alpha.compute()
        return model.noise_variance_, float(np.abs(alpha).mean())


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
                if found.status != "ok":
                    print(f"{n_frames:>9} {how}: {found.status} {found.message}")
                    continue
                seconds = found.seconds
                ratio = seconds / before.setdefault((how, n_jobs), seconds)
                print(
                    f"{n_frames:>9} {how:8} {n_jobs} job(s) {seconds:8.1f}"
                    f"{found.memory:8.0f}{ratio:8.2f}  {found.values[0]:.6g}",
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
        transform = [*package, "transform", model, table, "--output", output]
        for title, command, against, reference in (
            ("--version", [*package, "--version"], "python", nothing),
            ("--help", [*package, "--help"], "python", nothing),
            ("fit --help", [*package, "fit", "--help"], "python", nothing),
            ("transform, one frame", transform, "imports", imports),
        ):
            compare(title, command, reference, options.pairs, against, process_seconds)


def threads(options):
    """Two BLAS threads beside another program, relative to one."""
    X = make_nonrigid_tracks(2000, 68, 6, noise=0.02, random_state=0).data
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
    X = make_nonrigid_tracks(8000, 68, n_components=9, noise=0.02, random_state=0).data
    dense = make_nonrigid_tracks(2500, 7308, 8, noise=0.02, random_state=0).data
    long, model = np.tile(X, (40, 1)), AffineNRSfM(9, random_state=0)
    cases = [
        ("transform, 320,000 x 68", model.fit(X), "transform", long),
        ("fit, 320,000 x 68", model, "fit", long),
        ("fit, 2500 x 7308", AffineNRSfM(8, random_state=0), "fit", dense),
    ]
    yoga = load_table(YOGA)
    if yoga is not None:
        body = AffineNRSfM(
            "auto", camera="orthographic", refinement="consensus", random_state=0
        )
        cases.append(("consensus, yoga", body, "fit", yoga))
    for title, one, method, table in cases:
        one, two = (copy.copy(one).set_params(n_jobs=number) for number in (1, 2))
        compare(
            title,
            partial(getattr(two, method), table),
            partial(getattr(one, method), table),
            options.pairs,
        )


SECTIONS = {
    "start": start,
    "frames": frames,
    "fits": fits,
    "large": large,
    "long": long,
    "live": live,
    "new_frames": new_frames,
    "optima": optima,
    "fastisa": fastisa_iteration,
    "threads": threads,
    "jobs": jobs,
}

if __name__ == "__main__":
    pairs = {"type": int, "default": 5, "help": "pairs that are timed (default 5)"}
    run(__doc__, SECTIONS, n_seeds=1, options={"pairs": pairs})
