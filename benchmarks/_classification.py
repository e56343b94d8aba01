"""Section classification: expressions from coefficients and from other features."""

from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.model_selection import GroupKFold, StratifiedKFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from benchmarks._methods import CALIBRATED, METHOD_TITLES, METHODS
from benchmarks._results import grid, remarks
from benchmarks._run import Section, every_seed
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
        return METHODS["joint"].make(chosen, 2 * K, seed)
    if method in METHODS:
        return METHODS[method].make(chosen, K, seed)
    pca = PCA(3 * K + 3 if method.endswith("_more") else K, random_state=seed)
    if method.startswith("true"):
        return pca
    return make_pipeline(AlignedFrames(turn=method.startswith("aligned")), pca)


def runs(sets, methods, repeats):
    """Return a run for each set, features and seed, which says the folds."""
    return [
        (name, method, *rest)
        for name, method, *rest in every_seed(sets, methods, repeats)
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
    cv = kind(FOLDS, shuffle=True, random_state=seed)
    options = {"groups": data.subjects, "cv": cv, "error_score": "raise"}
    with measured():
        scores = 100 * cross_val_score(classifier, X, data.labels, **options)
    return {"accuracy": scores.mean(), "folds": scores}


def page(records):
    """Return the tables of the section."""
    titles = {"titles": FEATURES, "headings": SET_TITLES, "corner": "features"}
    return "\n".join(
        [
            "Accuracy in percent, mean of five folds, median over the seeds that draw "
            "the folds, and range. One classifier, standardised features and linear "
            "discriminant analysis, in a `Pipeline` with the features, which are "
            "fitted inside of the folds. Folds hold different subjects on ICT-68. Of "
            "expressions the subjects are not known: a person may be on both sides of "
            "a fold, which helps all features.\n",
            grid(records, measure="accuracy", **titles),
            remarks(records, FEATURES),
        ]
    )


CLASSIFICATION = Section(
    "Classification of expressions",
    measure_accuracy,
    page,
    ("ict_68", "expressions"),
    tuple(FEATURES),
    runs=runs,
)
