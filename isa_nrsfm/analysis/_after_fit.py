"""What a fit warns of: other objects than those of a prior, mirrored rows, outliers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.texts import first_items
from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm.analysis._advice import (
    SAME_UNIT,
    depth_advice,
    facts_of,
    layout_of,
    outlier_advice,
    with_outliers,
)

# Least share of the area between two directions in the image, relative to the largest
# ones of the table, of a row whose side is known: docs/benchmarks/README.md,
# "Thresholds".
LEAST_AREA = 0.5
# Largest `prior_std_` of people and annotators, on the same page.
LARGEST_WIDTH = 0.2


def warn_after_fit(
    model: Any,
    prior: Any,
    motion: NDArray,
    left_out: tuple[NDArray, NDArray] | None,
) -> None:
    """Warn of what a joint fit shows of its table.

    motion (n_rows, 2, 3): cameras. left_out: distances (n, J) of `left_out_distances`,
    and the numbers of their rows. Most rows mirrored: the prior has the wrong sign.
    """
    rows, message = mirrored_rows(model, prior, motion)
    if prior is not None and len(rows) > len(motion) / 2:
        model.mirror_certainty_ = 1.0 - model.mirror_certainty_
    if prior is not None and (width := model.prior_std_[0]) > LARGEST_WIDTH:
        warn_caller(
            f"the mean shape lies {width:.2g} sizes of the object from that of the "
            "prior, farther than those of people and annotators: depths may be wrong. "
            f"Make sure that the points are those of the prior, and that {SAME_UNIT}; "
            "or fit the table without a prior"
        )
    facts = facts_of(model)
    if left_out is not None:
        facts = with_outliers(facts, *left_out)
    advice = filter(None, (outlier_advice(facts), depth_advice(facts)))
    for text in (message, ". ".join(advice)):
        if text:
            warn_caller(text)


def mirrored_rows(model: Any, prior: Any, motion: NDArray) -> tuple[NDArray, str]:
    """Return the rows that show an object from behind, and a message; empty if none.

    The image of a mirrored object is that of the object from behind, which shows no
    face. Of other objects it is impossible if no frame of a prior shows them so.
    motion (n_rows, 2, 3): cameras.
    """
    axes = _across_and_up(model, prior)
    if axes is None:
        return np.zeros(0, dtype=int), ""
    images = motion @ axes.T / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
    area = np.linalg.det(images)  # negative from the front, if y points down
    threshold = LEAST_AREA * np.nanquantile(np.abs(area), 0.9)
    rows, n = np.flatnonzero(area > threshold), np.count_nonzero(np.isfinite(area))
    alike = not (area < -threshold).any()
    if not len(rows) or (alike and prior is None):  # which is right for another y
        return rows[:0], ""
    (x, _), (y, up) = np.median(images[rows], axis=0)
    few = f"{len(rows)} of {n} rows ({first_items(rows, 12)})"
    which = f"all {n} rows" if alike else few
    text, way = f"{which} are mirror images", "change the sign of x in them"
    if abs(y) > abs(x):
        text, way = f"x and y are exchanged in {which}", "exchange them"
    elif up > 0:
        text, way = f"y points up in {which}", "change the sign of y in them"
    return rows, (
        f"{text}: they would show the object from behind. Their depths and rotations "
        f"are wrong. Make sure that y points down, and {way}"
    )


def _across_and_up(model: Any, prior: Any) -> NDArray | None:
    """Return the directions (2, 3) that images show to the right and upwards.

    None if the object may be seen from behind.
    """
    layout = layout_of(model if prior is None else prior)
    if layout is not None and layout.kind == "face":
        shape = model.mean_shape_
        pairs = layout.left_right, np.array(layout.up)
        return np.array(
            [np.mean(shape[b] - shape[a], 0) for a, b in (p.T for p in pairs)]
        )
    sights = None if prior is None else getattr(prior, "motion_", None)
    if sights is None:
        return None
    sights = full_rotations(sights)[0][:, 2]
    sights = sights[np.isfinite(sights[:, 0])]
    view = prior.reference_motion_ / np.linalg.norm(prior.reference_motion_)
    return view * [[1], [-1]] if (sights @ np.cross(*view) > 0).all() else None
