"""Section held_out: points that were held out, and the number of basis shapes."""

import numpy as np
from sklearn.model_selection import KFold, cross_val_score

from benchmarks._data import halves_of
from benchmarks._jobs import Job
from benchmarks._markdown import cell, grid, remarks, select, table, value
from benchmarks._methods import METHOD_TITLES, METHODS
from benchmarks._sets import (
    SET_TITLES,
    SETS,
    SYNTHETIC_NOISE,
    SYNTHETIC_POINTS,
    load,
)
from benchmarks.accuracy import held_out
from benchmarks.recovery import chosen_components, instance

# Of `AffineNRSfM`: the other methods say nothing of points that they do not see.
METHODS_WITH_SCORE = ("isa1", "isa2", "joint")
# Numbers of basis shapes to choose from, and what chooses.
CHOICES = {"ict_68": range(1, 14, 2), "drink": range(1, 9)}
CHOOSES = "joint"
FOLDS = 3
TRUE_NUMBERS = range(1, 6)


def jobs(section, sets, methods, repeats):
    """Return the jobs of both parts."""
    listed = []
    for seed in range(repeats):
        for name in sets:
            for method in methods if name != "synthetic" else ():
                arguments = {"name": name, "method": method, "seed": seed}
                parameters = {"part": "halves"}
                listed.append(
                    Job(section, name, method, seed, halves, arguments, parameters)
                )
            if CHOOSES not in methods:
                continue
            if name == "synthetic":
                for K in TRUE_NUMBERS:
                    arguments = {"n_components": K, "seed": seed}
                    parameters = {"part": "choice", "n_components": K}
                    listed.append(
                        Job(section, name, CHOOSES, seed, choice, arguments, parameters)
                    )
            for K in CHOICES.get(name, ()) if seed == 0 else ():
                arguments = {"name": name, "n_components": K}
                parameters = {"part": "curve", "n_components": K}
                listed.append(
                    Job(section, name, CHOOSES, seed, curve, arguments, parameters)
                )
    return listed


def halves(measured, name, method, seed):
    """Fit half of the frames, and predict held-out points of the other half."""
    chosen = SETS[name]
    X = load(name).X
    train, test = (X[rows] for rows in halves_of(len(X), seed))
    K, scale_frames = chosen.case.n_components, chosen.case.scale_frames
    model = METHODS[method].make(K, scale_frames, chosen.ordered, seed)
    with measured():
        model.fit(train)
    return {"held_out": held_out(model, test)}, {}


def choice(measured, n_components, seed):
    """Let a search find the number of basis shapes of a synthetic table."""
    tracks = instance(seed, SYNTHETIC_POINTS, n_components, SYNTHETIC_NOISE)
    with measured():
        found, _ = chosen_components(tracks.data)
    return {"found": found}, {}


def curve(measured, name, n_components):
    """Return the cross-validated error at held-out points for one choice."""
    chosen = SETS[name]
    model = METHODS[CHOOSES].make(
        n_components, chosen.case.scale_frames, chosen.ordered, 0
    )
    cv = KFold(FOLDS, shuffle=True, random_state=0)
    X = load(name).X
    with measured():
        scores = cross_val_score(model, X, cv=cv, error_score="raise")
    return {"held_out": -100 * float(np.mean(scores))}, {}


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
            value("held_out"),
            corner="method",
        ),
        choices_table(select(records, part="choice")),
    ]
    for name in CHOICES:
        rows = select(records, set=name, part="curve")
        if rows:
            parts.append(curve_table(name, rows))
    return "\n".join([*parts, remarks(records, METHOD_TITLES)])


def choices_table(records):
    """Return how often a search finds the number of basis shapes."""
    rows = []
    for K in TRUE_NUMBERS:
        of_number = select(records, n_components=K)
        numbers = [r.values["found"] for r in of_number if r.status == "ok"]
        if of_number:
            right = f"{sum(n == K for n in numbers)} of {len(of_number)}"
            rows.append([f"{K}", right, ", ".join(map(str, numbers))])
    if not rows:
        return ""
    title = (
        f"`GridSearchCV` over n_components 1 to 8, synthetic tables of "
        f"{SYNTHETIC_POINTS} points with {100 * SYNTHETIC_NOISE:g} % noise.\n\n"
    )
    return title + table(["true K", "found it", "found"], rows)


def curve_table(name, records):
    """Return the error by number of basis shapes, the lowest in bold."""
    cells = {K: select(records, n_components=K) for K in CHOICES[name]}
    errors = {K: r[0].values.get("held_out") for K, r in cells.items() if r}
    known = [error for error in errors.values() if error is not None]
    row = []
    for K in errors:
        text = cell(cells[K], value("held_out"))
        row.append(f"**{text}**" if known and errors[K] == min(known) else text)
    title = SET_TITLES[name].partition(",")[0]
    heading = (
        f"{title}: error at held-out points by n_components, {FOLDS} folds of the "
        f"frames, {METHOD_TITLES[CHOOSES]}, the lowest in bold.\n\n"
    )
    return heading + table(["K", *map(str, errors)], [["held-out error, %", *row]])
