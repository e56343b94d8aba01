"""
Print what fits of real tables reach: reprojection, 3D truth, unseen points.

Run ``python -m benchmarks.accuracy [section ...] [--seeds N]``. Errors in 3D are
`affine_shape_error`; inverse SNR is in percent, of frames scaled to unit size.
"""

import warnings

import numpy as np

from benchmarks._command import run
from benchmarks._data import (
    CASES,
    DRINK,
    FACES,
    HANDS,
    ICT,
    MUCT,
    PICKUP,
    SHARK,
    YOGA,
    as_table,
    halves_of,
    load_arrays,
    load_table,
)
from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm._block_structure import BLOCK_RECOVERIES
from isa_nrsfm._tracks import centred_tracks, weighting_sizes
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import affine_shape_error

PAPER = {
    "PooledFastICA": {},
    "FastISA": {"isa": FastISA()},
    **{
        f"no refinement, {name}": {"block_recovery": name, "refinement": None}
        for name in BLOCK_RECOVERIES
    },
}
TOLERANCES = (0.5, 0.05, 1e-2, 1e-3, 1e-5, 1e-7, 1e-10)
MOST_STEPS = 20_000


def fit(case, X, seed=0, **parameters):
    """Return the fit of a table as the case says."""
    settings = {"scale_frames": case.scale_frames, "random_state": seed}
    return AffineNRSfM(case.n_components, **{**settings, **parameters}).fit(X)


def error_3d(arrays, model, X):
    """Return the error of the reconstruction in 3D, NaN where there is no truth."""
    if "S3d" not in arrays:
        return np.nan
    return affine_shape_error(arrays["S3d"], model.reconstruct(X))


def rigid_error_3d(arrays, model):
    """Return the error in 3D of the mean shape alone."""
    if "S3d" not in arrays:
        return np.nan
    truth = arrays["S3d"]
    return affine_shape_error(truth, np.broadcast_to(model.mean_shape_, truth.shape))


def held_out(model, X):
    """Return the inverse SNR of points held out of the fits of their frames."""
    return -100 * model.score(X)


def paper(options):
    """The paper's refinement: inverse SNR over the seeds, and what choices change."""
    for case in CASES:
        X = load_table(case)
        if X is None:
            continue
        print(f"\n{case.title:36}{'min':>9}{'median':>9}{'max':>9}")
        for title, parameters in PAPER.items():
            models = [
                fit(case, X, seed, **{"refinement": "alternating", **parameters})
                for seed in range(options.seeds)
            ]
            values = [100 * model.inverse_snr_ for model in models]
            least, median, most = np.percentile(values, [0, 50, 100])
            print(f"{title:36}{least:9.4f}{median:9.4f}{most:9.4f}", flush=True)
        print(f"{'rank floor':36}{100 * models[0].rank_floor_:9.4f}")


def tables(options):
    """Joint refinement, all rows: reprojection, held-out points, 3D, largest alpha."""
    print(
        f"{'':22}{'inverse SNR: min':>17}{'max':>9}{'floor':>9}{'held out':>10}"
        f"{'3D: min':>10}{'max':>8}{'paper':>8}{'rigid':>8}{'alpha':>7}{'steps':>7}"
    )
    for case in (*CASES, *SHARK[:2]):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        models = [fit(case, X, seed) for seed in range(options.seeds)]
        snr = [100 * model.inverse_snr_ for model in models]
        errors = [error_3d(arrays, model, X) for model in models]
        alternating = fit(case, X, refinement="alternating")
        model = models[-1]
        print(
            f"{case.title:22}{min(snr):17.5f}{max(snr):9.5f}"
            f"{100 * model.rank_floor_:9.5f}{held_out(model, X):10.4f}"
            f"{min(errors):10.4f}{max(errors):8.4f}"
            f"{error_3d(arrays, alternating, X):8.4f}"
            f"{rigid_error_3d(arrays, alternating):8.4f}"
            f"{np.abs(model.alpha_).max():7.1f}{model.n_iter_:7}",
            flush=True,
        )


def halves(options):
    """Trained on half of the faces: held-out points of the others, to the paper's."""
    print(f"{'':28}{'joint':>8}{'paper':>8}{'ratio':>8}")
    for case, complete in ((FACES, True), (MUCT, True), (MUCT, False)):
        X = load_table(case, complete)
        if X is None:
            continue
        for seed in range(options.seeds):
            train, test = (X[rows] for rows in halves_of(len(X), seed))
            joint = held_out(fit(case, train, seed), test)
            other = held_out(fit(case, train, seed, refinement="alternating"), test)
            title = f"{case.title}, {'complete' if complete else 'all'} rows"
            print(f"{title:28}{joint:8.4f}{other:8.4f}{joint / other:8.3f}", flush=True)


def eta_squared(values, labels):
    """Return the between-class share of the variance of each column."""
    centred = values - values.mean(axis=0)
    between = sum(
        np.sum(labels == label) * centred[labels == label].mean(axis=0) ** 2
        for label in np.unique(labels)
    )
    return between / np.sum(centred**2, axis=0)


def classes(options):
    """ICT: share of each coefficient's variance between the expressions, sorted."""
    arrays = load_arrays(ICT)
    if arrays is None:
        return
    X = as_table(arrays["W2d"])
    for independence in ("coefficients", "shapes", None):
        for seed in range(options.seeds):
            model = fit(ICT, X, seed, independence=independence)
            shares = np.sort(eta_squared(model.alpha_, arrays["labels"]))[::-1]
            print(
                f"{independence!s:14}{np.array2string(shares, precision=2)}  "
                f"{np.sum(shares >= 0.5)} at least 0.5, "
                f"{np.sum(shares <= 0.05)} at most 0.05",
                flush=True,
            )


def missing(options):
    """30 % of the points missing: 3D error relative to the complete table."""
    for case in (ICT, DRINK):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        clean = error_3d(arrays, fit(case, X), X)
        for seed in range(options.seeds):
            tracks = arrays["W2d"].astype(float)
            hidden = np.random.default_rng(seed).random(tracks.shape[:2]) < 0.3
            tracks[hidden] = np.nan
            holes = as_table(tracks)
            model = fit(case, holes, seed)
            error = error_3d(arrays, model, holes)
            filled = model.reproject(holes).reshape(tracks.shape)
            centred, _ = centred_tracks(arrays["W2d"])
            wrong = (filled - arrays["W2d"])[hidden]
            print(
                f"{case.title:18}3D {error:.4f}, complete {clean:.4f}, ratio "
                f"{error / clean:.3f}; unseen points, inverse SNR "
                f"{100 * np.sum(wrong**2) / np.sum(centred[hidden] ** 2):.4f} %",
                flush=True,
            )
    X = load_table(MUCT, complete=False)
    if X is not None:
        model = fit(MUCT, X)
        finite = np.isfinite(model.alpha_).all() and np.isfinite(model.reproject(X))
        print(
            f"{MUCT.title}, {len(X)} rows, {np.isnan(X).any(axis=1).sum()} with holes: "
            f"inverse SNR {100 * model.inverse_snr_:.4f}, held out "
            f"{held_out(model, X):.4f}, finite {bool(np.all(finite))}"
        )


def spoiled(tracks, kind, rng, share=0.05):
    """
    Return tracks with a share of the points spoiled.

    They are moved in a random direction by a number of sizes of their frame, `kind`, or
    by 0.3 to 3 sizes ("mixed"), or put anywhere within 3 sizes ("anywhere").
    """
    centred, centroids = centred_tracks(tracks)
    sizes = weighting_sizes(centred, True)[:, None, None]
    chosen = rng.random(tracks.shape[:2]) < share
    angle = rng.uniform(0, 2 * np.pi, tracks.shape[:2])
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    lengths = 0.3 * 10 ** rng.random(tracks.shape[:2])[..., None]
    anywhere = centroids[:, None] + sizes * rng.uniform(-3, 3, tracks.shape)
    if kind == "anywhere":
        return np.where(chosen[..., None], anywhere, tracks)
    if kind != "mixed":
        lengths = kind
    return np.where(chosen[..., None], tracks + lengths * sizes * direction, tracks)


def outliers(options):
    """5 % of the points moved by 0.3 to 3 sizes of the frame: 3D error."""
    kinds = (0.3, 1.0, 3.0, "mixed", "anywhere")
    print(
        f"moved by {kinds}: 3D error, and its ratio to the clean one of the same loss"
    )
    for case in (ICT, DRINK):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        for loss in ("linear", "huber", "cauchy"):
            clean = error_3d(arrays, fit(case, X, loss=loss), X)
            for seed in range(options.seeds):
                errors = []
                for kind in kinds:
                    rng = np.random.default_rng(seed)
                    Y = as_table(spoiled(arrays["W2d"], kind, rng))
                    errors.append(error_3d(arrays, fit(case, Y, seed, loss=loss), Y))
                errors = np.array(errors)
                print(
                    f"{case.title:12}{loss:>8} clean {clean:.4f}  "
                    f"{np.array2string(errors, precision=4, floatmode='fixed')} "
                    f"{np.array2string(errors / clean, precision=2)}",
                    flush=True,
                )


def tolerances(options):
    """3D error at tolerances from 0.5 to 1e-10, largest over smallest."""
    for case in (ICT, DRINK, PICKUP, YOGA):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        errors = []
        print(case.title)
        for tol in TOLERANCES:
            model = fit(case, X, tol=tol, max_iter=options.steps)
            errors.append(error_3d(arrays, model, X))
            print(
                f"  tol {tol:<8g} 3D {errors[-1]:.5f}  inverse SNR "
                f"{100 * model.inverse_snr_:.5f}  steps {model.n_iter_:6}  largest "
                f"alpha {np.abs(model.alpha_).max():.1f}",
                flush=True,
            )
        print(f"  largest over smallest {max(errors) / min(errors):.4f}", flush=True)


def stiffness(options):
    """Free and stiff shapes: held-out points of held-out frames, and 3D."""
    print(f"{'':18}{'stiffness':>10}{'held out':>10}{'3D':>9}{'chosen':>8}")
    for case in (DRINK, PICKUP, YOGA, ICT, HANDS, MUCT):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        train, test = (X[rows] for rows in halves_of(len(X), 0))
        for price in (0.0, 300.0, None):
            held = held_out(fit(case, train, stiffness=price), test)
            model = fit(case, X, stiffness=price)
            print(
                f"{case.title:18}{price!s:>10}{held:10.5f}"
                f"{error_3d(arrays, model, X):9.4f}{model.stiffness_:8.0f}",
                flush=True,
            )


def starts(options):
    """Other starts: 3D difference to the default fit, and the objective."""
    others = {
        **{f"seed {seed}": {"seed": seed} for seed in range(1, options.seeds + 1)},
        "FastISA": {"isa": FastISA()},
        "block recovery irls": {"block_recovery": "irls"},
        "frames in another order": {},
    }
    for case in (ICT, DRINK, FACES):
        X = load_table(case)
        if X is None:
            continue
        first = fit(case, X)
        shapes = first.reconstruct(X)
        print(f"{case.title}: objective {first.objective_history_[-1]:.2f}")
        for title, parameters in others.items():
            table = X[::-1] if title.startswith("frames") else X
            other = fit(case, table, **parameters)
            difference = affine_shape_error(shapes, other.reconstruct(X))
            print(
                f"  {title:26}3D difference {100 * difference:8.4f} %  objective "
                f"{other.objective_history_[-1]:.2f}",
                flush=True,
            )


def planar(random_state=0):
    """Return a table of a flat shape that deforms in its plane."""
    flat = make_nonrigid_tracks(n_components=2, random_state=random_state)
    shapes = flat.shapes * [1.0, 1.0, 0.0]
    images = shapes @ flat.motion.transpose(0, 2, 1)
    noise = np.random.default_rng(0).normal(size=images.shape)
    return as_table(images + 1e-3 * noise)


def degenerate_tables():
    """Return tables with something degenerate, and how they are fitted, by name."""
    tracks = make_nonrigid_tracks(noise=0.01, random_state=0)
    rigid = make_nonrigid_tracks(n_components=0, noise=0.01, random_state=0)
    exact = make_nonrigid_tracks(n_components=0, random_state=0)
    two = tracks.motion.copy()
    two[:150], two[150:] = tracks.motion[0], tracks.motion[1]
    views = tracks.shapes @ two.transpose(0, 2, 1)
    doubled = np.concatenate([tracks.tracks, tracks.tracks[:, :10]], axis=1)
    cases = {
        "planar": (planar(), 2),
        "rigid, noise": (rigid.data, 1),
        "rigid, no noise": (exact.data, 1),
        "every frame thrice": (np.tile(tracks.data, (3, 1)), 3),
        "one frame 200 times": (
            np.concatenate([tracks.data, np.tile(tracks.data[:1], (200, 1))]),
            3,
        ),
        "ten points doubled": (as_table(doubled), 3),
        "two cameras": (as_table(views), 3),
    }
    for case in SHARK:
        X = load_table(case)
        if X is not None:
            cases[case.title] = (X, case.n_components)
    return cases


def degenerate(options):
    """Degenerate tables: finite, the same twice, warnings, 3D where known."""
    print(
        f"{'':22}{'finite':>7}{'again':>7}{'inverse SNR':>13}{'held out':>10}  warnings"
    )
    for title, (X, n_components) in degenerate_tables().items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            models = [
                AffineNRSfM(n_components, random_state=0).fit(X) for _ in range(2)
            ]
            score = held_out(models[0], X)
        finite = all(
            np.isfinite(values).all()
            for name, values in vars(models[0]).items()
            if name.endswith("_") and isinstance(values, np.ndarray | float)
        )
        again = np.array_equal(models[0].alpha_, models[1].alpha_)
        kinds = sorted(
            {f"{w.category.__name__}: {str(w.message)[:50]}" for w in caught}
        )
        print(
            f"{title:22}{finite!s:>7}{again!s:>7}{100 * models[0].inverse_snr_:13.3g}"
            f"{score:10.3g}  {'; '.join(kinds) or 'none'}",
            flush=True,
        )


SECTIONS = {
    "tables": tables,
    "halves": halves,
    "classes": classes,
    "missing": missing,
    "outliers": outliers,
    "tolerances": tolerances,
    "stiffness": stiffness,
    "starts": starts,
    "degenerate": degenerate,
    "paper": paper,
}

if __name__ == "__main__":
    steps = {"type": int, "default": MOST_STEPS, "help": "most steps of `tolerances`"}
    run(__doc__, SECTIONS, n_seeds=1, options={"steps": steps})
