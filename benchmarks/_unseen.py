"""Section held_out: points that were held out, and the number of basis shapes."""

import numpy as np
from sklearn.model_selection import GridSearchCV, KFold, cross_val_score

from benchmarks._methods import METHOD_TITLES, METHODS
from benchmarks._results import cell, found, grid, remarks, select, table
from benchmarks._run import Section
from benchmarks._sets import (
    SET_TITLES,
    SETS,
    SYNTHETIC_NOISE,
    SYNTHETIC_POINTS,
    halves_of,
    instance,
    load,
)
from isa_nrsfm import AffineNRSfM

# Numbers of basis shapes to choose from, and what chooses.
CHOICES = {"ict_68": range(1, 14, 2), "drink": range(1, 9)}
CHOOSES = "joint"
FOLDS = 3
TRUE_NUMBERS = range(1, 6)


def runs(sets, methods, repeats):
    """Return the runs of the three parts: halves, choice and curve."""
    halves = {"part": "halves"}
    listed = [
        (name, method, seed, halves)
        for seed in range(repeats)
        for name in sets
        for method in methods
        if name != "synthetic"
    ]
    if CHOOSES not in methods:
        return listed
    listed += [
        ("synthetic", CHOOSES, seed, {"part": "choice", "n_components": K})
        for seed in range(repeats)
        for K in TRUE_NUMBERS
        if "synthetic" in sets
    ]
    return listed + [
        (name, CHOOSES, 0, {"part": "curve", "n_components": K})
        for name in sets
        for K in CHOICES.get(name, ())
    ]


def measure_unseen(measured, name, method, seed, part, n_components=None):
    """
    Return the error at held-out points, or the number of basis shapes that is found.

    Fit half of the frames and predict the other half ("halves"), let a search find the
    number of a synthetic table ("choice"), or cross-validate one number ("curve").
    """
    if part == "choice":
        size = SYNTHETIC_POINTS, n_components, SYNTHETIC_NOISE
        tracks = instance(seed, *size)
        with measured():
            return {"found": chosen_components(tracks.data)}
    X, chosen = load(name).X, SETS[name]
    K = n_components or chosen.case.n_components
    model = METHODS[method].make(chosen, K, seed)
    if part == "halves":
        train, test = (X[rows] for rows in halves_of(len(X), seed))
        with measured():
            model.fit(train)
        return {"held_out": -100 * model.score(test)}
    cv = KFold(FOLDS, shuffle=True, random_state=0)
    with measured():
        scores = cross_val_score(model, X, cv=cv, error_score="raise")
    return {"held_out": -100 * np.mean(scores)}


def chosen_components(X):
    """Return the n_components that GridSearchCV finds."""
    numbers = {"n_components": range(1, 9)}
    search = GridSearchCV(AffineNRSfM(random_state=0), numbers, cv=KFold(FOLDS))
    return search.fit(X).best_params_["n_components"]


def page(records):
    """Return the tables of the section."""
    parts = [
        "Error at points held out of the fit of their frame, inverse SNR in percent, "
        "of frames that were not in the fit either: fitted to a random half, judged on "
        "the other half. The other methods do not predict unseen points.\n",
        grid(
            select(records, part="halves"),
            METHOD_TITLES,
            SET_TITLES,
            "held_out",
        ),
        choices_table(select(records, part="choice")),
    ]
    for name in CHOICES:
        rows = select(records, set=name, part="curve")
        if len(rows):
            parts.append(curve_table(name, rows))
    return "\n".join([*parts, remarks(records, METHOD_TITLES)])


def choices_table(records):
    """Return how often a search finds the number of basis shapes."""
    rows = []
    for K, of_number in records.groupby("n_components"):
        numbers = found(of_number, "found").astype(int)
        right = f"{sum(numbers == K)} of {len(of_number)}"
        rows.append([f"{K:g}", right, ", ".join(map(str, numbers))])
    if not rows:
        return ""
    title = (
        f"`GridSearchCV` over n_components 1 to 8, synthetic tables of "
        f"{SYNTHETIC_POINTS} points with {100 * SYNTHETIC_NOISE:g} % noise.\n\n"
    )
    return title + table(["true K", "found it", "found"], rows)


def curve_table(name, records):
    """Return the error by number of basis shapes, the lowest in bold."""
    groups = dict(list(records.groupby("n_components")))
    lowest = records["held_out"].min()
    cells = [
        f"**{cell(group, 'held_out')}**"
        if group["held_out"].min() == lowest
        else cell(group, "held_out")
        for group in groups.values()
    ]
    title = SET_TITLES[name].partition(",")[0]
    heading = (
        f"{title}: error at held-out points by n_components, {FOLDS} folds of the "
        f"frames, {METHOD_TITLES[CHOOSES]}, the lowest in bold.\n\n"
    )
    headings = ["K", *(f"{K:g}" for K in groups)]
    return heading + table(headings, [["held-out error, %", *cells]])


HELD_OUT = Section(
    "Held-out points and choice of K",
    measure_unseen,
    page,
    ("shark", "ict_68", "drink", "muct_68", "faces_wild", "synthetic"),
    # Of `AffineNRSfM`: the others say nothing of points that they do not see.
    ("isa1", "isa2", "joint"),
    runs=runs,
)
