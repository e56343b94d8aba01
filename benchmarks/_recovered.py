"""Section recovery: known basis shapes, by number of points, noise and basis shapes."""

from benchmarks._figures import draw_curves
from benchmarks._jobs import Job
from benchmarks._markdown import remarks, value
from benchmarks._methods import METHOD_TITLES, METHODS
from benchmarks._sweep import Sweep
from benchmarks.recovery import instance, least_similarity
from isa_nrsfm.metrics import affine_shape_error

SWEEP = Sweep(
    base={"n_points": 68, "n_components": 3, "noise": 0.02},
    varied={
        "n_points": (25, 40, 68, 150, 500),
        "n_components": (1, 2, 3, 5, 9),
        "noise": (0.0, 0.005, 0.01, 0.02, 0.05),
    },
    axes={
        "n_points": "points",
        "n_components": "basis shapes K",
        "noise": "noise (share of the points' root mean square)",
    },
)
# By name: what is said of it, and significant digits.
MEASURES = {
    "similarity_modulo": (
        "Lowest `basis_similarity` of a basis shape, multiples of the mean shape left "
        "out; one is perfect.",
        4,
    ),
    "similarity": (
        "The same with the multiples of the mean shape, which images do not tell: "
        "below one for any method.",
        4,
    ),
    "affine_shape_error": ("`affine_shape_error` of the frames, lower is better.", 3),
}


def jobs(section, sets, methods, repeats):
    """Return a job for each setting, method and seed."""
    return [
        Job(
            section,
            name,
            method,
            seed,
            measure_recovery,
            {"method": method, "seed": seed, **setting},
            setting,
        )
        for seed in range(repeats)
        for name in sets
        for method in methods
        for setting in SWEEP.settings()
    ]


def measure_recovery(measured, method, seed, **setting):
    """Fit tracks of a known basis; the seed also says which."""
    tracks = instance(seed, **setting)
    model = METHODS[method].make(setting["n_components"], True, False, seed)
    with measured():
        model.fit(tracks.data)
    plain, modulo = least_similarity(tracks, model)
    result = METHODS[method].found(model, tracks.data)
    values = {
        "similarity": plain,
        "similarity_modulo": modulo,
        "affine_shape_error": affine_shape_error(tracks.shapes, result.affine),
    }
    return values, {}


def page(records):
    """Return the tables of the section."""
    parts = [
        "Tables of `make_nonrigid_tracks`; weak-perspective and affine cameras, 300 to "
        "500 frames and amplitudes of 15 to 20 %, by seed. Where nothing else is said "
        f"{SWEEP.base['n_points']} points, K={SWEEP.base['n_components']}, "
        f"{100 * SWEEP.base['noise']:g} % noise. Median over the seeds and range.\n"
    ]
    for measure, (title, digits) in MEASURES.items():
        parts.append(title + "\n")
        parts += SWEEP.tables(records, METHOD_TITLES, value(measure), digits)
    return "\n".join([*parts, remarks(records, METHOD_TITLES)])


def draw(records, folder):
    """Draw the similarity of the basis shapes, and return the name of the file."""
    file = "recovery.png"
    draw_curves(
        SWEEP.panels(records),
        METHOD_TITLES,
        folder / file,
        measures={"lowest similarity of a basis shape": value("similarity_modulo")},
    )
    return [file]
