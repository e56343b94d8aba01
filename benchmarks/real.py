"""
Print what fits of real photos know of the camera that took them.

Run ``python -m benchmarks.real [muct rafd] [--seeds N]``: five and ten minutes of one
core. Cameras took the photos of a moment at the same time, so that turns of the cameras
and shapes are known, and the numbers of these photos should be the same. No fit is told
which photos belong together.

Both print tables in markdown, which are those of ``docs/benchmarks/real.md``.
"""

import warnings
from itertools import product

import numpy as np
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.impute import SimpleImputer
from sklearn.model_selection import GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from benchmarks._results import table
from benchmarks._run import run_sections
from benchmarks._sets import MUCT, Case, as_table, load_arrays
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.analysis import AlignedFrames, between_share
from isa_nrsfm.datasets import load_face_prior
from isa_nrsfm.metrics import mean_shape_error_3d

MUCT_TRUTH = Case("MUCT in 3D", "muct_views", 9)
RAFD = Case("RaFD", "rafd_106", 9)
# Points of MUCT without the jaw, and of RaFD; those of iBUG-68 among the latter.
MUCT_INNER, RAFD_INNER = slice(15, 68), slice(33, 104)
RAFD_68 = [*range(0, 33, 2), *range(33, 52), *range(52, 64), *range(84, 104)]
REMOVED = ", `remove_pose`"
PEOPLE = {"0, 3, 6, ...": 3, "0, 2, 4, ...": 2}
# Views of RaFD that are learnt and predicted: left, front and right are 0, 1 and 2.
PREDICTED = {
    "front, front": [(1, 1)],
    "front, turned": [(1, 0), (1, 2)],
    "left, right": [(0, 2), (2, 0)],
}


def turns(rotations, n_views, first):
    """Return median turns of n_views cameras against one of them, in degrees."""
    R = rotations.reshape(-1, n_views, 3, 3)
    against = (R @ R[:, [first]].mT).reshape(-1, 3, 3)
    angles = Rotation.from_matrix(against).magnitude().reshape(-1, n_views)
    return np.delete(np.degrees(np.median(angles, axis=0)), first)


def camera_share(alpha, n_views):
    """Return shares of the variance of coefficients between views of the same moments.

    Their mean square over the moments, of which all have all views: eta squared.
    """
    views = alpha.reshape(-1, n_views, alpha.shape[1])
    return views.mean(axis=0).var(axis=0) / alpha.var(axis=0)


def common_shape(shapes):
    """Return the mean (J, 3) of shapes (n, J, 3) after similarities."""
    mean = shapes[0]
    for _ in range(5):
        mean = np.mean([procrustes(mean, shape)[1] for shape in shapes], axis=0)
    return mean


def shown(values, digits=2):
    """Return numbers as a text."""
    return " ".join(f"{value:.{digits}f}" for value in np.ravel(values))


def muct(options):
    """MUCT, 53 inner points, weak perspective: shapes, turns, what the camera explains.

    The last two columns are of the coefficients along principal axes: the largest share
    of a variance that the camera explains, and the mean intraclass correlation of the
    five photos of a moment.
    """
    arrays, truth = load_arrays(MUCT), load_arrays(MUCT_TRUTH)
    if arrays is None or truth is None:
        return
    keys = ("camera", "lighting", "subjects")
    order = np.lexsort([arrays[key] for key in keys])
    views = arrays["W2d"][order][:, MUCT_INNER].reshape(-1, 5, 2 * 53)
    person, moments = arrays["subjects"][order][::5], np.arange(len(views))
    mean_shape, rows = common_shape(truth["S3d"]), []
    for (people, step), seed in product(PEOPLE.items(), range(options.seeds)):
        chosen = np.isin(person, np.unique(person)[::step])
        X, moment = np.vstack(views[chosen]), np.repeat(moments[chosen], 5)
        known = np.isin(moment, truth["moment"])
        shapes = truth["S3d"][np.searchsorted(truth["moment"], moment[known])]
        options = {"independence": None, "random_state": seed}
        for K, removed in (*product((3, 6, 9, "auto"), [False]), (9, True)):
            model = AffineNRSfM(
                K, camera="weak_perspective", remove_pose=removed, **options
            )
            with warnings.catch_warnings(action="ignore"):  # of depths
                alpha, found = model.fit_transform(X), model.reconstruct(X)[known]
            pairs = (mean_shape[None], model.mean_shape_[None]), (shapes, found)
            errors = [mean_shape_error_3d(*p, convention="frame") for p in pairs]
            cells = [people, f"{K}{REMOVED * removed}", *map("{:.3f}".format, errors)]
            cells += [shown(turns(model.rotations_, 5, 0), 1)]
            cells += [f"{model.depth_uncertainty_:.2f}", *of_camera(alpha, moment)]
            rows.append(cells)
        for n in (3, 6, 9):
            pca = make_pipeline(SimpleImputer(), AlignedFrames(), PCA(n))
            cells = of_camera(pca.fit_transform(X), moment)
            rows.append([people, f"PCA, {n}", *[""] * 4, *cells])
    head = "people", "K", "mean shape", "photos", "turns of b, c, d, e"
    print(table([*head, "depth error, stated", "camera explains", "ICC"], rows))


def of_camera(alpha, moment):
    """Return the largest share that the camera explains, and the mean ICC, as texts."""
    icc = between_share(alpha, moment).between.mean()
    return [f"{camera_share(alpha, 5).max():.2f}", f"{icc:.2f}"]


def rafd(options):
    """RaFD: expressions of other people in other views, percent right.

    Linear discriminants of numbers that are learnt from all photos of the training
    people, without labels. Labels are learnt from one view. Five folds of people, means
    of both directions.
    """
    arrays, rows = load_arrays(RAFD), []
    if arrays is None:
        return
    for seed in range(options.seeds):
        points, y, person = in_views(arrays)
        for name, (X, steps) in methods_of(points, seed).items():
            scores, angles = predicted(X, steps, y, person)
            right = [f"{100 * value:.0f}" for value in scores.values()]
            rows.append([name, *right, shown(angles, 0)])
            print(*rows[-1], sep="; ", flush=True)
    print(table(["numbers", *PREDICTED, "turns of the cameras (45)"], rows))


def in_views(arrays):
    """Return points (n, 106, 2), expressions and people of RaFD, view by view."""
    keys = ("camera", "emotion", "person")
    order = np.lexsort([arrays[key] for key in keys])
    points, y, person = (arrays[key][order] for key in ("W2d", "emotion", "person"))
    return points.astype(float), y, person


def methods_of(points, seed):
    """Return the table and the transformer of each kind of numbers, by name."""
    inner, as_68 = as_table(points[:, RAFD_INNER]), as_table(points[:, RAFD_68])
    calibrated = {"camera": "weak_perspective", "random_state": seed}
    prior = FunctionTransformer(load_face_prior(9).transform)
    methods = {"face prior, transform, K = 9": (as_68, prior)}
    for K, removed in product((9, 18), (False, True)):
        fit = AffineNRSfM(K, remove_pose=removed, **calibrated)
        methods[f"own fit, K = {K}{REMOVED * removed}"] = inner, fit
    fit = AffineNRSfM(9, prior=load_face_prior(9), remove_pose=True, **calibrated)
    methods[f"face prior, fit, K = 9{REMOVED}"] = as_68, fit
    for n in (9, 18, 30):
        pca = make_pipeline(AlignedFrames(), PCA(n, random_state=seed))
        methods[f"PCA of aligned points, {n}"] = inner, pca
    return methods


def predicted(X, steps, y, person):
    """Return shares of right predictions by views, and the turns of the cameras."""
    scores, angles, views = {kind: [] for kind in PREDICTED}, [], np.arange(len(y)) % 3
    folds = GroupKFold(5, shuffle=True, random_state=0).split(X, y, person)
    for learn, test in folds:
        with warnings.catch_warnings(action="ignore"):  # of depths, other faces
            Z, others = steps.fit_transform(X[learn]), steps.transform(X[test])
        if hasattr(steps, "rotations_"):
            angles.append(turns(steps.rotations_, 3, 1))
        for kind, pairs in PREDICTED.items():
            for one, other in pairs:
                a, b = views[learn] == one, views[test] == other
                model = LinearDiscriminantAnalysis().fit(Z[a], y[learn][a])
                scores[kind].append(model.score(others[b], y[test][b]))
    means = {kind: float(np.mean(values)) for kind, values in scores.items()}
    return means, np.mean(angles, axis=0) if angles else []


SECTIONS = {"muct": muct, "rafd": rafd}

if __name__ == "__main__":
    run_sections(__doc__, SECTIONS)
