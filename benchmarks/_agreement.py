"""Section agreement: how far fits with different seeds are the same."""

from itertools import combinations, product
from typing import NamedTuple

from benchmarks._jobs import Job
from benchmarks._markdown import cell, remarks, select, table, value
from benchmarks._sets import SET_TITLES, SETS, load
from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.metrics import affine_shape_error, basis_similarity, subspace_distance

ISA1 = {"refinement": "alternating", "isa": FastISA()}
ISA2 = {"refinement": "alternating"}


class Comparison(NamedTuple):
    """
    Two kinds of fits that are compared; of one kind, if they are the same.

    Attributes
    ----------
    title : str
        What it is called.
    one, other : dict
        Parameters of AffineNRSfM.
    """

    title: str
    one: dict
    other: dict


COMPARISONS = {
    "isa1": Comparison("ISA1", ISA1, ISA1),
    "isa2": Comparison("ISA2", ISA2, ISA2),
    "isa1_isa2": Comparison("ISA1 and ISA2", ISA1, ISA2),
    "joint": Comparison("joint, independent shapes", {}, {}),
    "joint_coefficients": Comparison(
        "joint, independent coefficients",
        {"independence": "coefficients"},
        {"independence": "coefficients"},
    ),
}
TITLES = {name: comparison.title for name, comparison in COMPARISONS.items()}
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


def jobs(section, sets, methods, repeats):
    """Return a job for each set and comparison."""
    n_seeds = max(repeats, 2)
    return [
        Job(
            section,
            name,
            method,
            0,
            measure_agreement,
            {"name": name, "method": method, "n_seeds": n_seeds},
            {"n_seeds": n_seeds},
        )
        for name in sets
        for method in methods
    ]


def measure_agreement(measured, name, method, n_seeds):
    """Fit a table with several seeds, and compare the fits pair by pair."""
    comparison = COMPARISONS[method]
    X = load(name).X
    case = SETS[name].case

    def fits(parameters):
        models = [
            AffineNRSfM(
                case.n_components,
                scale_frames=case.scale_frames,
                random_state=seed,
                **parameters,
            )
            for seed in range(n_seeds)
        ]
        for model in models:
            with measured():
                model.fit(X)
        return models

    ones = fits(comparison.one)
    if comparison.one == comparison.other:
        pairs = list(combinations(ones, 2))
    else:
        pairs = list(product(ones, fits(comparison.other)))
    compared = [compare(a, b, X) for a, b in pairs]
    if comparison.one.get("refinement") != "alternating":
        for distances in compared:
            del distances["subspaces"]  # those of the start
    values = {key: [pair[key] for pair in compared] for key in compared[0]}
    return values, {}


def compare(a, b, X):
    """Return how far two fits of a table are the same."""
    similarity = basis_similarity(
        a.basis_,
        b.basis_,
        mean_shape_true=a.mean_shape_,
        mean_shape=b.mean_shape_,
        modulo_mean_shape=True,
    )
    shapes = affine_shape_error(a.reconstruct(X), b.reconstruct(X))
    subspaces = subspace_distance(a.isa_.components_, b.isa_.components_)
    return {
        "subspaces": subspaces,
        "basis": similarity.min(),
        "mean_basis": similarity.mean(),
        "shapes": shapes,
    }


def page(records):
    """Return the tables of the section."""
    sets = [name for name in SET_TITLES if select(records, set=name)]
    parts = [
        "Fits of the same table with different seeds, compared pair by pair: median "
        "over the pairs and range. Basis shapes without their multiples of the mean "
        "shape. ISA1 and ISA2 with the paper's refinement.\n"
    ]
    for measure, (title, digits) in MEASURES.items():
        rows = [
            [
                TITLES[method],
                *(
                    _cell(select(records, method=method, set=s), measure, digits)
                    for s in sets
                ),
            ]
            for method in TITLES
            if select(records, method=method)
        ]
        rows = [row for row in rows if any(row[1:])]
        if rows:
            parts += [title + "\n", table(["", *(SET_TITLES[s] for s in sets)], rows)]
    return "\n".join([*parts, remarks(records, TITLES)])


def _cell(records, measure, digits):
    """Return the spread of a list of values of the one record there is."""
    one_each = [
        record._replace(values={measure: item})
        for record in records
        for item in record.values.get(measure, [None])
    ]
    return cell(one_each, value(measure), digits)
