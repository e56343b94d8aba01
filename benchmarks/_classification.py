"""Section classification: expressions from coefficients and from other features."""

from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.model_selection import GroupKFold, StratifiedKFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from benchmarks._figures import draw_bars
from benchmarks._jobs import Job
from benchmarks._markdown import grid, remarks, value
from benchmarks._methods import CALIBRATED, METHOD_TITLES, METHODS
from benchmarks._sets import SET_TITLES, SETS, load
from isa_nrsfm.analysis import AlignedFrames

FOLDS = 5
# Methods without coefficients, or with those of another one, and a method with twice
# as many.
WITHOUT, MORE = ("floor", "rigid", *CALIBRATED), "joint_more"
FEATURES = {
    **{name: title for name, title in METHOD_TITLES.items() if name not in WITHOUT},
    MORE: "ISA, joint refinement, 2K",
    "pca": "PCA of the table, K",
    "pca_more": "PCA of the table, 3K + 3",
    "aligned_pca": "PCA of aligned frames, K",
    "aligned_pca_more": "PCA of aligned frames, 3K + 3",
    "true_pca": "PCA of the true 3D shapes, K",
    "true_pca_more": "PCA of the true 3D shapes, 3K + 3",
}


def features(method, chosen, seed):
    """Return the transformer of a method for a set."""
    K = chosen.case.n_components
    if method == MORE:
        return METHODS["joint"].make(2 * K, chosen.case.scale_frames, False, seed)
    if method in METHODS:
        return METHODS[method].make(K, chosen.case.scale_frames, chosen.ordered, seed)
    pca = PCA(3 * K + 3 if method.endswith("_more") else K, random_state=seed)
    if method.startswith("true"):
        return pca
    return make_pipeline(AlignedFrames(turn=method.startswith("aligned")), pca)


def jobs(section, sets, methods, repeats):
    """Return a job for each set, features and seed, which says the folds."""
    return [
        Job(
            section,
            name,
            method,
            seed,
            measure_accuracy,
            {"name": name, "method": method, "seed": seed},
            {},
        )
        for seed in range(repeats)
        for name in sets
        for method in methods
        if SETS[name].truth or not method.startswith("true")
    ]


def measure_accuracy(measured, name, method, seed):
    """Cross-validate a pipeline whose features are fitted inside of the folds."""
    data = load(name)
    X = data.X
    if method.startswith("true"):
        X = data.shapes.reshape(len(X), -1)
    kind = StratifiedKFold if data.subjects is None else GroupKFold
    classifier = make_pipeline(
        features(method, SETS[name], seed),
        StandardScaler(),
        LinearDiscriminantAnalysis(),
    )
    with measured():
        scores = cross_val_score(
            classifier,
            X,
            data.labels,
            groups=data.subjects,
            cv=kind(FOLDS, shuffle=True, random_state=seed),
            error_score="raise",
        )
    values = {
        "accuracy": 100 * scores.mean(),
        "spread": 100 * scores.std(ddof=1),
        "folds": 100 * scores,
    }
    return values, {}


def page(records):
    """Return the tables of the section."""
    return "\n".join(
        [
            "Accuracy in percent, mean of five folds, median over the seeds that draw "
            "the folds, and range. One classifier, standardised features and linear "
            "discriminant analysis, in a `Pipeline` with the features, which are "
            "fitted inside of the folds. Folds hold different subjects on ICT-68. Of "
            "expressions the subjects are not known: a person may be on both sides of "
            "a fold, which helps all features.\n",
            _grid(records, value("accuracy")),
            "Standard deviation between the folds, percent.\n",
            _grid(records, value("spread"), digits=2),
            "Seconds of the five folds.\n",
            _grid(records, lambda record: record.seconds),
            remarks(records, FEATURES),
        ]
    )


def _grid(records, measure, digits=3):
    """Return a table with a row for each kind of features."""
    return grid(
        records, FEATURES, SET_TITLES, measure, corner="features", digits=digits
    )


def draw(records, folder):
    """Draw the accuracy, and return the name of the file."""
    file = "classification.png"
    draw_bars(
        records,
        FEATURES,
        SET_TITLES,
        value("accuracy"),
        folder / file,
        label="accuracy, %",
        log=False,
    )
    return [file]
