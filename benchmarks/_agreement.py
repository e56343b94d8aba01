"""Section agreement: how far fits with different seeds are the same."""

from itertools import combinations, product

from benchmarks._results import grid, remarks
from benchmarks._run import Section
from benchmarks._sets import SET_TITLES, SETS, load
from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.metrics import affine_shape_error, basis_similarity, subspace_distance

ISA1 = {"refinement": "alternating", "isa": FastISA()}
ISA2 = {"refinement": "alternating"}
COEFFICIENTS = {"independence": "coefficients"}
# Title and parameters of two kinds of fits that are compared.
COMPARISONS = {
    "isa1": ("ISA1", ISA1, ISA1),
    "isa2": ("ISA2", ISA2, ISA2),
    "isa1_isa2": ("ISA1 and ISA2", ISA1, ISA2),
    "joint": ("joint, independent shapes", {}, {}),
    "joint_coefficients": (
        "joint, independent coefficients",
        COEFFICIENTS,
        COEFFICIENTS,
    ),
}
TITLES = {name: title for name, (title, _, _) in COMPARISONS.items()}
# By name: what is said of it, and significant digits.
MEASURES = {
    "subspaces": (
        "`subspace_distance` of the independent subspaces, 0 is the same.",
        3,
    ),
    "basis": ("Lowest `basis_similarity` of a basis shape, 1 is the same.", 4),
    "mean_basis": ("Mean `basis_similarity` of the basis shapes.", 4),
    "shapes": (
        "`affine_shape_error` between the shapes of the frames, 0 is the same.",
        3,
    ),
}


def runs(sets, methods, repeats):
    """Return a run for each set and comparison."""
    seeds = {"n_seeds": max(repeats, 2)}
    return [(name, method, 0, seeds) for name in sets for method in methods]


def measure_agreement(measured, name, method, seed, n_seeds):
    """Fit a table with several seeds, and compare the fits pair by pair."""
    X, case = load(name).X, SETS[name].case

    def fits(parameters):
        settings = {"scale_frames": case.scale_frames, **parameters}
        for seed in range(n_seeds):
            model = AffineNRSfM(case.n_components, random_state=seed, **settings)
            with measured():
                model.fit(X)
            yield model

    _, one, other = COMPARISONS[method]
    ones = list(fits(one))
    pairs = combinations(ones, 2) if one == other else product(ones, fits(other))
    compared = [compare(a, b, X) for a, b in pairs]
    names = set(compared[0])
    if one.get("refinement") != "alternating":
        names -= {"subspaces"}  # those of the start
    return {name: [pair[name] for pair in compared] for name in names}


def compare(a, b, X):
    """Return how far two fits of a table are the same."""
    similarity = basis_similarity(
        a.basis_,
        b.basis_,
        mean_shape_true=a.mean_shape_,
        mean_shape=b.mean_shape_,
        modulo_mean_shape=True,
    )
    return {
        "subspaces": subspace_distance(a.isa_.components_, b.isa_.components_),
        "basis": similarity.min(),
        "mean_basis": similarity.mean(),
        "shapes": affine_shape_error(a.reconstruct(X), b.reconstruct(X)),
    }


def page(records):
    """Return the tables of the section."""
    parts = [
        "Fits of the same table with different seeds, compared pair by pair: median "
        "over the pairs and range. Basis shapes without their multiples of the mean "
        "shape. ISA1 and ISA2 with the paper's refinement.\n"
    ]
    for measure, (title, digits) in MEASURES.items():
        known = records[records[measure].notna()].explode(measure)
        table = grid(known, TITLES, SET_TITLES, measure, corner="", digits=digits)
        if table:
            parts += [title + "\n", table]
    return "\n".join([*parts, remarks(records, TITLES)])


AGREEMENT = Section(
    "Agreement across seeds",
    measure_agreement,
    page,
    ("ict_68", "drink", "faces_wild", "synthetic"),
    tuple(COMPARISONS),
    tuple(SETS),
    runs=runs,
)
