"""
Print what fits say of labels, people, time and head pose, and levels of p-values.

Run ``python -m benchmarks.questions [section ...] [--seeds N]``: about two minutes, and
ten for ``chance`` and ``turned`` each. Figures of the pages are those of the first
seed. The generated faces of ``turned`` need no data.
"""

import warnings

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.impute import SimpleImputer
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from benchmarks._run import run_sections
from benchmarks._sets import (
    DRINK,
    EXPRESSIONS,
    FACES,
    ICT,
    MUCT,
    PICKUP,
    YOGA,
    Case,
    as_table,
    centred_tracks,
    load_arrays,
    load_table,
    rotations_and_scales,
    spoiled,
)
from benchmarks.accuracy import common_rotation
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.analysis import (
    AlignedFrames,
    WithinGroups,
    association,
    between_share,
    predictability,
)
from isa_nrsfm.calibration import view_angles
from isa_nrsfm.datasets import load_face_prior, make_face_tracks
from isa_nrsfm.export import frame_poses
from isa_nrsfm.skeletons import get_skeleton

# Numbers of basis shapes of motion capture.
K_OF_BODIES = (6, 12)
# Expressions of other people by another annotator, and its names of the same ones.
OTHER_EXPRESSIONS = Case("other expressions", "expressions_ewan_68", 9)
SAME_NAMES = {"joy": "happy", "suprise": "surprise"}
# Noise and share of the points that are missing there.
NOISE, MISSING = 0.02, 0.3
# The y axis of ICT-68 points up and its z axis to the viewer; angles are told of images
# whose y axis points down.
Y_DOWN = np.diag([1.0, -1.0, -1.0])
# Degrees from the front, and to the side; which views are predicted from which.
NEAR, FRONTAL, TURNED, ASIDE = 10, 15, 25, 15
LEARNT = {
    "all": ("all",),
    "frontal": ("frontal", "turned"),
    "left": ("left", "right"),
    "near": ("turned",),
}


def told(features, labels, groups, seed):
    """Return with which accuracy features tell labels, with its standard error."""
    scores = 100 * predictability(features, labels, groups, random_state=seed)
    return f"{scores.mean():.1f} +- {scores.std(ddof=1) / np.sqrt(len(scores)):.1f} %"


def labels(options):
    """Expressions: eta squared, p-values, and accuracy, of PCA of aligned frames, too.

    PCA has K and 3 K + 3 components. Folds hold different people where these are known.
    """
    for case, K in ((ICT, 9), (EXPRESSIONS, 8)):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X, names, people = load_table(case), arrays["labels"], arrays.get("subjects")
        for seed in range(options.seeds):
            alpha = AffineNRSfM(K, random_state=seed).fit_transform(X)
            found = association(alpha, names, people, random_state=seed)
            aligned = PCA(3 * K + 3, random_state=seed).fit_transform(
                AlignedFrames().fit_transform(X)
            )
            print(f"{case.file}, K={K}")
            print(f"  eta squared {found.statistic.round(2)}")
            print(f"  p-values    {found.p_value.round(3)}")
            features = {"coefficients": alpha, "PCA, K": aligned[:, :K]}
            features["PCA, 3 K + 3"] = aligned
            if people is not None:
                own = WithinGroups().fit_transform(alpha, groups=people)
                features["coefficients relative to the person"] = own
            for name, values in features.items():
                accuracy = told(values, names, people, seed)
                print(f"  {name:36}{accuracy}", flush=True)


def rhythm(rng, k, period=30, damping=0.99, n=900):
    """Return k oscillations (n, k) that forget their phase."""
    noise = rng.normal(size=(n + 1000, k))
    recursion = [1, -2 * damping * np.cos(2 * np.pi / period), damping**2]
    return lfilter([1], recursion, noise, axis=0)[1000:]


def slow(rng, k, memory, n=500):
    """Return k autoregressions (n, k) of the first order."""
    noise = rng.normal(size=(n + 1000, k))
    return lfilter([1], [1, -memory], noise, axis=0)[1000:]


def periodic(rng, k, noise=0.2, n=900):
    """Return k waves (n, k) with one period and some noise."""
    phases = 2 * np.pi * (np.arange(n)[:, None] / 37.3 + rng.random(k))
    return np.sin(phases) + noise * rng.normal(size=(n, k))


def drift(rng, k, n=400):
    """Return k linear drifts (n, k) with noise."""
    slopes = 2 * rng.normal(size=k)
    return np.linspace(-2, 2, n)[:, None] * slopes + rng.normal(size=(n, k))


def classes(rng, n, length):
    """Return two classes (n,) that change after `length` frames on average."""
    return np.repeat(rng.integers(2, size=n), rng.geometric(1 / length, n))[:n]


def clips(rng, k, n_clips, size, memory=0.9):
    """Return coefficients (n, k) of clips with own means, and the clips (n,)."""
    clip = np.repeat(np.arange(n_clips), size)
    within = np.concatenate([slow(rng, k, memory, size) for _ in range(n_clips)])
    return within + 3 * rng.normal(size=(n_clips, k))[clip], clip


def of_groups(rng, values, group, constant):
    """Return coefficients, classes of groups or frames, and the groups."""
    labels = rng.integers(2, size=group.max() + 1)[group]
    return values, labels if constant else classes(rng, len(group), 20), group


# Series and a label that has nothing to do with them, from a generator of numbers.
UNRELATED = {
    "photos, classes": lambda r: (r.normal(size=(200, 3)), r.integers(2, size=200)),
    "photos, numbers": lambda r: (r.normal(size=(200, 3)), r.normal(size=200)),
    "photos sorted by class": lambda r: (
        r.normal(size=(200, 3)),
        np.sort(r.integers(2, size=200)),
    ),
    "photos of 20 people, label of the person": lambda r: of_groups(
        r, *clips(r, 3, 20, 10, 0.0), True
    ),
    "videos of 8 people, classes": lambda r: of_groups(r, *clips(r, 3, 8, 60), False),
    **{
        f"AR(1) of {memory}, {kind}": lambda r, memory=memory, kind=kind: (
            slow(r, 3, memory),
            slow(r, 1, memory)[:, 0] if kind == "numbers" else classes(r, 500, 20),
        )
        for memory, kind in ((0.3, "numbers"), (0.9, "classes"), (0.98, "numbers"))
    },
    **{
        f"rhythm of {period}, damping {damping}": lambda r, p=period, d=damping: (
            rhythm(r, 3, p, d),
            rhythm(r, 1, p, d)[:, 0],
        )
        for period, damping in ((30, 0.97), (30, 0.99), (12, 0.99), (60, 0.99))
    },
    "waves of one period": lambda r: (periodic(r, 3), periodic(r, 1)[:, 0]),
    "random walks": lambda r: (slow(r, 3, 1.0), slow(r, 1, 1.0)[:, 0]),
    "drift, a label that changes once": lambda r: (
        drift(r, 3),
        np.arange(400) >= r.integers(100, 300),
    ),
    "eight clips, not told": lambda r: of_groups(r, *clips(r, 3, 8, 100), True)[:2],
}
# The same with an effect of half a standard deviation on the second coefficient.
RELATED = {
    name: UNRELATED[name] for name in ("photos, classes", "rhythm of 30, damping 0.97")
} | {
    "rhythm of 30, damping 0.99": UNRELATED["rhythm of 30, damping 0.99"],
    "rhythm of 30, damping 0.99, classes": lambda r: (
        rhythm(r, 3),
        classes(r, 900, 20),
    ),
    "AR(1) of 0.9, 900 frames, classes": lambda r: (
        slow(r, 3, 0.9, 900),
        classes(r, 900, 20),
    ),
}


def chance(options):
    """Generated series: how often a label is significant at .05, or is not tested.

    Of 500 labels that are unrelated, and 200 that are related.
    """
    print(f"{'':52}{'significant, %':>16}{'not tested, %':>16}")
    for title, cases, n in (("unrelated", UNRELATED, 500), ("related", RELATED, 200)):
        for name, case in cases.items():
            least = []
            for seed in range(n):
                alpha, y, *groups = case(np.random.default_rng(seed))
                if len(np.unique(y)) == 1:
                    continue
                if title == "related":
                    effect = y if y.dtype.kind in "bi" else y / y.std()
                    alpha[:, 1] += 0.5 * alpha[:, 1].std() * effect
                found = association(
                    alpha, y, *groups, n_permutations=199, random_state=seed
                )
                p = found.p_value
                least.append(p[1] if title == "related" else p.min())
            share = [100 * np.mean(np.array(least) <= 0.05)]
            share.append(100 * np.mean(np.isnan(least)))
            print(
                f"{title + ': ' + name:46}{share[0]:16.1f}{share[1]:16.1f}", flush=True
            )


def people(options):
    """ICT-68: share of the variance of each coefficient that lies between people."""
    arrays = load_arrays(ICT)
    if arrays is None:
        return
    X = load_table(ICT)
    for independence in ("coefficients", "shapes"):
        for seed in range(options.seeds):
            model = AffineNRSfM(9, independence=independence, random_state=seed).fit(X)
            share = between_share(model.alpha_, arrays["subjects"])
            print(f"{independence:14}{share.between.round(2)}", flush=True)


def turned_error(shapes, truth):
    """
    Return the mean error of shapes, each after the best rotation, relative to its size.

    Parameters
    ----------
    shapes, truth : ndarray of shape (n_frames, n_points, 3)
        Shapes; of the two mirror images the better one counts.

    Returns
    -------
    float
        The mean of ``||S_i R_i - T_i|| / ||T_i||`` over the frames.
    """
    S, T = (each - each.mean(axis=1, keepdims=True) for each in (shapes, truth))
    errors = []
    for mirror in (1.0, -1.0):
        own = S * [1.0, 1.0, mirror]
        turns = [Rotation.align_vectors(b, a)[0] for a, b in zip(own, T, strict=True)]
        off = own @ Rotation.concatenate(turns).as_matrix().transpose(0, 2, 1) - T
        size = np.linalg.norm(T, axis=(1, 2))
        errors.append(np.mean(np.linalg.norm(off, axis=(1, 2)) / size))
    return min(errors)


def smoothing(options):
    """Motion capture, 2 % noise, 30 % missing: 3D error after smoothing over before.

    "complete" is the ratio of the coefficients of complete frames without noise, for
    the same basis shapes; "shuffled" how much smoothing changes frames in any order,
    relative to the coefficients.
    """
    print(f"{'':22}{'before':>9}{'smooth':>9}{'complete':>10}{'shuffled':>10}")
    for case in (YOGA, PICKUP, DRINK):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        clean, truth = centred_tracks(arrays["W2d"].astype(float)), arrays["S3d"]
        for K in K_OF_BODIES:
            for seed in range(options.seeds):
                rng = np.random.default_rng(seed)
                X = spoiled(clean, rng, NOISE, MISSING)
                model = AffineNRSfM(K, camera="orthographic", random_state=seed).fit(X)
                before, smooth, complete = (
                    turned_error(
                        model.mean_shape_ + np.tensordot(alpha, model.basis_, 1), truth
                    )
                    for alpha in (
                        model.alpha_,
                        model.smooth(X).alpha,
                        model.transform(as_table(clean)),
                    )
                )
                order = rng.permutation(len(X))
                change = model.smooth(X[order]).alpha - model.transform(X[order])
                change = np.linalg.norm(change) / np.linalg.norm(model.alpha_)
                print(
                    f"{f'{case.file} K={K}':22}{before:9.4f}{smooth / before:9.2f}"
                    f"{complete / before:10.2f}{change:10.1g}",
                    flush=True,
                )


def poses(options):
    """Head pose: degrees off after one common rotation, errors over deviations.

    The last column is the root mean square of the errors of yaw, each divided by its
    posterior standard deviation; calibrated cameras have one.
    """
    tables = []
    arrays = load_arrays(ICT)
    if arrays is not None:
        tables.append(("ICT-68, K=9", load_table(ICT), Y_DOWN @ arrays["R"], 9))
    for seed in range(options.seeds):
        faces = make_face_tracks(300, noise=0.01, random_state=seed)
        true = rotations_and_scales(faces.motion)[0]
        tables.append((f"synthetic faces {seed}, K=4", faces.data, true, 4))
    print(f"{'':26}{'camera':18}{'median':>8}{'yaw: errors / deviations':>26}")
    for title, X, truth, K in tables:
        for camera in ("weak_perspective", "affine"):
            model = AffineNRSfM(K, camera=camera, random_state=0).fit(X)
            pose = frame_poses(model, X)
            angles = np.stack([pose.roll, -pose.pitch, -pose.yaw], axis=1)
            found = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
            true = truth @ common_rotation(truth, found)
            apart = Rotation.from_matrix(true.transpose(0, 2, 1) @ found).magnitude()
            off = (pose.yaw - view_angles(true).yaw + 180) % 360 - 180
            ratio = np.sqrt(np.mean((off / pose.yaw_std) ** 2))
            print(
                f"{title:26}{camera:18}{np.degrees(np.median(apart)):8.2f}{ratio:26.2f}",
                flush=True,
            )


def studies(options):
    """Labels that are learnt on one table and predicted on the other, percent right."""
    tables, names = [], []
    for case in (EXPRESSIONS, OTHER_EXPRESSIONS):
        arrays = load_arrays(case)
        if arrays is None:
            return
        y = np.array([SAME_NAMES.get(name, name) for name in arrays["labels"]])
        tables.append(load_table(case))
        names.append(y)
    common = [np.isin(y, names[1 - i]) for i, y in enumerate(names)]
    names = [y[used] for y, used in zip(names, common, strict=True)]

    def show(title, of_first, of_second=None):
        """Print the accuracy in both directions; features may differ in these."""
        right = []
        for learnt, features in enumerate((of_first, of_second or of_first)):
            X, Z = (each[used] for each, used in zip(features, common, strict=True))
            if learnt:
                X, Z = Z, X
            classifier = make_pipeline(StandardScaler(), LinearDiscriminantAnalysis())
            classifier.fit(X, names[learnt])
            right.append(100 * classifier.score(Z, names[1 - learnt]))
        print(f"{title:44}{right[0]:8.1f}{right[1]:8.1f}", flush=True)

    print(f"{'learnt on':44}{'first':>8}{'second':>8}")
    aligned = [AlignedFrames().fit(X) for X in tables]
    points = [[each.transform(X) for X in tables] for each in aligned]
    for n in (9, 18, 30):
        pca = [PCA(n, random_state=0).fit(points[i][i]) for i in (0, 1)]
        both = [[pca[i].transform(X) for X in points[i]] for i in (0, 1)]
        show(f"PCA of aligned points, {n}", *both)
    calibrated = {"camera": "weak_perspective", "random_state": 0}
    with warnings.catch_warnings(action="ignore"):  # of depths, and of other tables
        own = [AffineNRSfM(9, **calibrated).fit(X) for X in tables]
        show("own fits, K=9", [model.alpha_ for model in own])
        both = [[model.transform(X) for X in tables] for model in own]
        show("transform, model of the first table, K=9", *both)
        for K in (9, 40):
            prior = load_face_prior(K)
            show(f"transform, face prior, K={K}", [prior.transform(X) for X in tables])
            model = AffineNRSfM(K, prior=prior, **calibrated)
            show(f"face prior, K={K}", [model.fit_transform(X) for X in tables])


def views_of(rotations):
    """Return which faces are seen from where, by name; y and z may point backwards."""
    side, front = rotations[:, [0, 2], 2].T * np.sign(rotations[:, 2, 2])
    turned, yaw = np.degrees([np.arccos(front), np.arctan2(side, front)])
    return {
        "all": turned >= 0,
        "near": turned < NEAR,
        "frontal": turned < FRONTAL,
        "turned": turned > TURNED,
        "left": yaw < -ASIDE,
        "right": yaw > ASIDE,
    }


def features_of(layout, numbers, seed=0):
    """Return steps from points of a layout to features, by name."""
    columns = {"indices": get_skeleton(layout).inner_columns, "axis": 1}
    inner = FunctionTransformer(np.take, kw_args=columns)
    alpha = AffineNRSfM(camera="weak_perspective", random_state=seed)
    features = {
        f"alpha, K={K}": [clone(alpha).set_params(n_components=K)] for K in numbers
    }
    for n in (9, 18, 30):
        pca = [AlignedFrames(), PCA(n, random_state=seed)]
        features[f"PCA of aligned points, {n}"] = pca
    return {
        f"{name}{ending}": make_pipeline(*first, *steps, StandardScaler())
        for ending, first in (("", ()), (", inner points", (inner,)))
        for name, steps in features.items()
    }


def scores_of(steps, X, y, people, views):
    """Return scores of other people by kinds of views, (learnt, predicted)."""
    numbers = y.dtype.kind == "f"
    last = LinearRegression() if numbers else LinearDiscriminantAnalysis()
    scores = {(learnt, other): [] for learnt in LEARNT for other in LEARNT[learnt]}
    folds = GroupKFold(5, shuffle=True, random_state=0)
    for learn, test in folds.split(X, y, people):
        for learnt, others in LEARNT.items():
            rows = learn[views[learnt][learn]]
            with warnings.catch_warnings(action="ignore"):  # of depths, other people
                model = make_pipeline(steps, last).fit(X[rows], y[rows])
                for other in others:
                    rows = test[views[other][test]]
                    scores[learnt, other].append(model.score(X[rows], y[rows]))
    return {kinds: np.mean(values) for kinds, values in scores.items()}


def seen_faces(seed):
    """Yield title, table, what is predicted, people and rotations of faces."""
    faces = make_face_tracks(1000, n_components=8, random_state=seed)
    rotations, _ = rotations_and_scales(faces.motion)
    each = np.arange(len(rotations))
    yield "generated faces of one person", faces.data, faces.labels, each, rotations
    arrays = load_arrays(ICT)
    if arrays is not None:
        rest = (arrays[name] for name in ("labels", "subjects", "R"))
        yield "ICT-68", load_table(ICT), *rest
    photos = load_table(FACES)
    if photos is not None:
        photos = photos[::4]
        with warnings.catch_warnings(action="ignore"):  # of another annotator
            cameras = load_face_prior(9).decompose(photos).motion
        points = photos.reshape(len(photos), -1, 2)
        lips, nose = np.linalg.norm(points[:, [62, 27]] - points[:, [66, 33]], axis=2).T
        rotations, _ = rotations_and_scales(cameras)
        title = "photos: R^2 of the root of (opening of the mouth / length of the nose)"
        yield title, photos, np.sqrt(lips / nose), np.arange(len(photos)), rotations


def listed(name, figures):
    """Print a row of texts or shares."""
    cells = (f"{c:>10}" if isinstance(c, str) else f"{c:10.3f}" for c in figures)
    print(f"{name:40}" + "".join(cells), flush=True)


def turned(options):
    """Faces of other people in other views: share right; all is learnt in one view.

    Near and frontal: within 10 and 15 degrees; turned: by more than 25; left and right:
    a yaw of more than 15. Linear discriminant analysis, five folds of people.
    """
    kinds = [(learnt, other) for learnt in LEARNT for other in LEARNT[learnt]]
    for seed in range(options.seeds):
        for title, X, y, people, rotations in seen_faces(seed):
            views = views_of(rotations)
            print(f"{title}: " + ", ".join(f"{v.sum()} {k}" for k, v in views.items()))
            listed("learnt", [learnt for learnt, _ in kinds])
            listed("predicted", [other for _, other in kinds])
            for name, steps in features_of("ibug-68", [9], seed).items():
                listed(name, scores_of(steps, X, y, people, views).values())


def identity(options):
    """MUCT: share of the people whose photos of other cameras have the right neighbour.

    The nearest of the 751 photos of camera a, first of all moments, then of all but the
    moment of the photo. Inner points; PCA has the means of columns where points are
    missing.
    """
    arrays = load_arrays(MUCT)
    if arrays is None:
        return
    order = np.lexsort([arrays[key] for key in ("camera", "lighting", "subjects")])
    X = as_table(arrays["W2d"][order, 15:])
    people = arrays["subjects"][order][::5]
    repeated = (people[:, None] == people).sum(axis=1) > 1
    calibrated = {"camera": "weak_perspective", "random_state": 0}
    steps = {"standardised alpha, K=18": [AffineNRSfM(18, **calibrated)]}
    for removed in (False, True):
        alpha = AffineNRSfM(30, independence=None, remove_pose=removed, **calibrated)
        steps[f"principal axes, K=30{', remove_pose' * removed}"] = [alpha]
    steps["PCA, 30"] = [SimpleImputer(), AlignedFrames(), PCA(30, random_state=0)]
    listed("camera", "bcdebcde")
    for name, parts in steps.items():
        with warnings.catch_warnings(action="ignore"):  # of depths
            features = make_pipeline(*parts).fit_transform(X)
        # Coefficients that the table does not support are zero.
        views = (
            StandardScaler().fit_transform(features).reshape(-1, 5, features.shape[1])
        )
        apart = [cdist(views[:, view], views[:, 0]) for view in range(1, 5)]
        right = [(people[d.argmin(axis=1)] == people).mean() for d in apart]
        for d in apart:
            np.fill_diagonal(d, np.inf)
        found = (people[d.argmin(axis=1)] == people for d in apart)
        listed(name, [*right, *(each[repeated].mean() for each in found)])


ALL = labels, chance, people, smoothing, poses, studies, turned, identity
SECTIONS = {each.__name__: each for each in ALL}

if __name__ == "__main__":
    run_sections(__doc__, SECTIONS)
