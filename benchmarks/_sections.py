"""The sections of the comparison: sets, methods, jobs, page and pictures of each."""

from collections.abc import Callable
from typing import NamedTuple

from benchmarks import (
    _agreement,
    _classification,
    _cost,
    _fits,
    _paper,
    _recovered,
    _unseen,
)
from benchmarks._methods import CALIBRATED, METHODS
from benchmarks._sets import SETS


def no_pictures(records, folder):
    """Draw nothing."""
    return []


class Section(NamedTuple):
    """
    A section of the comparison.

    Attributes
    ----------
    title : str
        Heading of its page.
    jobs : callable
        Returns the jobs for a section's name, sets, methods and repeats.
    page : callable
        Returns the page of records, in markdown.
    sets, methods : tuple of str
        What is measured, and of what, unless something else is chosen.
    other_sets, other_methods : tuple of str
        What can be chosen, too.
    draw : callable
        Draws pictures of records to a folder, and returns the names of the files.
    """

    title: str
    jobs: Callable
    page: Callable
    sets: tuple[str, ...]
    methods: tuple[str, ...]
    other_sets: tuple[str, ...] = ()
    other_methods: tuple[str, ...] = ()
    draw: Callable = no_pictures


SECTIONS = {
    "reprojection": Section(
        "Reprojection",
        _fits.jobs,
        _fits.reprojection_page,
        ("shark", "flag", "faces_wild", "ict_dense"),
        tuple(name for name in METHODS if name not in CALIBRATED),
        tuple(SETS),
        CALIBRATED,
        draw=_fits.draw_reprojection,
    ),
    "truth": Section(
        "3D truth",
        _fits.jobs,
        _fits.truth_page,
        (
            "shark",
            "flag",
            "ict_68",
            "drink",
            "pickup",
            "yoga",
            "synthetic",
            "synthetic_affine",
        ),
        tuple(name for name in METHODS if name != "consensus"),
        ("ict_dense", "drink_k11", "pickup_k11", "yoga_k9"),
        ("consensus",),
        draw=_fits.draw_truth,
    ),
    "recovery": Section(
        "Recovery of the basis",
        _recovered.jobs,
        _recovered.page,
        ("synthetic",),
        ("isa1", "isa2", "joint"),
        other_methods=("pi", "bmm", "kong_lucey"),
        draw=_recovered.draw,
    ),
    "held_out": Section(
        "Held-out points and choice of K",
        _unseen.jobs,
        _unseen.page,
        ("shark", "ict_68", "drink", "muct_68", "faces_wild", "synthetic"),
        _unseen.METHODS_WITH_SCORE,
    ),
    "classification": Section(
        "Classification of expressions",
        _classification.jobs,
        _classification.page,
        ("ict_68", "expressions"),
        tuple(_classification.FEATURES),
        draw=_classification.draw,
    ),
    "agreement": Section(
        "Agreement across seeds",
        _agreement.jobs,
        _agreement.page,
        ("ict_68", "drink", "faces_wild", "synthetic"),
        tuple(_agreement.COMPARISONS),
        tuple(SETS),
    ),
    "cost": Section(
        "Cost of a fit",
        _cost.jobs,
        _cost.page,
        ("synthetic",),
        ("joint", _cost.SVD),
        other_methods=("isa2",),
        draw=_cost.draw,
    ),
    "paper": Section(
        "The paper's experiments",
        _paper.jobs,
        _paper.page,
        tuple(_paper.PRINTED),
        _paper.COMPARED,
    ),
}
