"""Advice on a fit: from measured facts to at most three messages that agree."""

from collections.abc import Iterator
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.texts import first_items
from isa_nrsfm._fitted_model import frames_of
from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._frames.models import LARGEST_SHARE
from isa_nrsfm._joint.uncertainty import n_reliable
from isa_nrsfm._parameters import named
from isa_nrsfm._prepare.robust import MEDIAN_DISTANCE
from isa_nrsfm.skeletons import Skeleton, find_skeleton
from isa_nrsfm.skeletons._column_names import names_of_points

# Entries of V_k with a larger standard deviation count as not determined.
LARGEST_DEVIATION = 0.1
# Thresholds of the noise variance with calibrated cameras over that with affine ones.
# Below the first, the table does not contradict calibrated cameras. Above the second,
# the cameras are probably not calibrated. Measured on artificial tables: 1.02 for
# weak-perspective cameras, up to 1.2 for perspective ones at 8 to 2.5 radii, 22 to 48
# for cameras that stretch the image. Motion capture with too few basis shapes has 1.1
# to 4 (``python -m benchmarks.accuracy cameras``).
SAME_NOISE, OTHER_CAMERAS = 1.3, 10.0
SAME_UNIT = (
    "x and y have the same unit, unlike fractions of the width and height of an image"
)
# Errors of held-out points, as shares of the energy, up to which a fit is good, and
# above which it is poor; errors of depths likewise, of which the second withholds them.
# Few points and frames: docs/benchmarks/README.md, "Thresholds".
FIT, DEPTH = (0.02, 0.2), (0.2, LARGEST_SHARE)
# Error of depths above which every third one was in truth above `LARGEST_SHARE`, of
# fits without a prior: docs/depth.md, "Undetermined depth".
DOUBTFUL = 0.4
FEW_POINTS = 10
# What to do if other settings may be better; the command line does it by itself.
COMPARE = "isa_nrsfm.AutoNRSfM().fit(X) compares other settings by held-out points"
# Least length of gross residuals, in robust standard deviations.
GROSS = 8.0
# Share of the squared residuals, which a fit with the linear loss minimises, that gross
# ones have in a table with outliers: docs/benchmarks/README.md, "Thresholds".
MOST_GROSS = 0.04
MOST_MESSAGES = 3


class Facts(NamedTuple):
    """
    A model after a joint fit, and what was found of it.

    Attributes
    ----------
    model : AffineNRSfM
        The model; with ``_trials`` if settings were compared.
    held_out_error : float
        As in `Diagnostics`.
    deviation : float
        Largest standard deviation of the weakly determined parts of the basis shapes.
    outlier_energy : float
        As in `Diagnostics`.
    outliers, few, pose : str
        Descriptions of outliers, of coefficients that a few frames determine, and of
        those that the pose predicts; empty if there are none.
    """

    model: Any
    held_out_error: float = np.nan
    deviation: float = 0.0
    outlier_energy: float = np.nan
    outliers: str = ""
    few: str = ""
    pose: str = ""

    @property
    def compare(self) -> str:
        """What to do if other settings may be better; nothing if they were compared."""
        return "" if hasattr(self.model, "_trials") else f". {COMPARE}"

    @property
    def bent(self) -> bool:
        """Whether outliers have their full influence on the fit."""
        linear = frames_of(self.model).loss == "linear"
        return linear and self.outlier_energy > MOST_GROSS


def layout_of(model: Any) -> Skeleton | None:
    """Return the layout of the points of a model, by their names or mean image."""
    names, image = names_of_points(model), model.mean_shape_ @ model.reference_motion_.T
    return find_skeleton(len(names), names, shape=image)


def verdict(error: float, good: float, poor: float) -> str:
    """Return whether an error is good, fair or poor; empty if it is not known."""
    if np.isnan(error):
        return ""
    return "good" if error <= good else "fair" if error <= poor else "poor"


def advice(facts: Facts) -> tuple[str, ...]:
    """Return what happened, why, and what to do: the most important messages."""
    return tuple(islice(filter(None, _messages(facts)), MOST_MESSAGES))


def _messages(facts: Facts) -> Iterator[str]:
    """Yield messages that do not contradict each other, the most important first.

    Those that name other settings do so once: after a comparison of settings, messages
    say what the recording lacks.
    """
    if verdict(facts.held_out_error, *FIT) == "poor":
        yield poor_fit(facts)
        return
    yield outlier_advice(facts)
    yield depth_advice(facts)
    if facts.bent:  # outliers may cause all that follows
        return
    model, n_components = facts.model, len(facts.model.reliability_)
    n_supported = n_reliable(model.reliability_)
    # A consensus has many small components. Without those that are noise, the next
    # smallest ones are.
    if n_supported and model.refinement == "consensus":
        n_supported = n_components
    if not n_supported:
        yield (
            "no deformation was found beyond the noise: the object may be rigid. Do "
            "not interpret the coefficients"
        )
        return
    ratio = getattr(model, "camera_noise_ratio_", np.nan)
    if ratio >= OTHER_CAMERAS and model.camera_ != "affine":
        yield f"{camera_meaning(ratio)}. Make sure that {SAME_UNIT}"
        return  # wrong cameras look like coefficients that depend on the pose
    if n_supported < n_components and model.prior is None and facts.compare:
        yield (
            f"the table does not support {named('n_components', n_components)}: "
            f"{n_components - n_supported} direction(s) of the coefficients are "
            f"probably noise{facts.compare}"
        )
    elif model.camera_ == "affine" and facts.deviation > LARGEST_DEVIATION:
        yield (
            f"the basis shapes are uncertain by up to {100 * facts.deviation:.2g} % of "
            "the mean shape: affine cameras absorb such deformation. Record more "
            f"frames, best of objects that turn further{facts.compare}"
        )
    if n_supported == n_components:
        yield facts.few
    if frames_of(model).certainty.determined:
        yield facts.pose


def poor_fit(facts: Facts) -> str:
    """Return the message on a fit that does not predict held-out points."""
    text = (
        "the fit is poor: points left out of it are not predicted by the others of "
        f"their frame ({100 * facts.held_out_error:.2g} % unexplained). Do not "
        "interpret it. "
    )
    if (n_points := len(facts.model.mean_shape_)) < FEW_POINTS:
        return f"{text}There are {n_points} points only: record more of the body"
    return (
        f"{text}The points are not those of one deforming body, or a column is not the "
        "same point in all rows, or rows are too few for so large movements"
    )


def facts_of_rows(model: Any, distance: NDArray, rows: NDArray) -> Facts:
    """Return a model and the outliers among distances (n, J) of some rows (n,)."""
    share, energy, found = gross_residuals(distance)
    wrong = list(dict.fromkeys(rows[found[:, 0]].tolist()))
    text = (
        f"the table has outliers: {100 * share:.2g} % of the points of {len(rows)} "
        f"rows are more than {GROSS:g} standard deviations from where the others of "
        f"their frame have them, most in the rows {first_items(wrong, 5)}"
    )
    return Facts(model, outlier_energy=energy, outliers=text)


def outlier_advice(facts: Facts) -> str:
    """Return the message on outliers that bend the shapes."""
    if not facts.bent:
        return ""
    return f"{facts.outliers}: they bend the shapes. Correct them{facts.compare}"


def known_depth(model: Any) -> bool:
    """Return whether the depths of a joint fit are determined and not doubtful."""
    most = DOUBTFUL if model.prior is None else LARGEST_SHARE
    return model.camera_ != "affine" and not frames_of(model).certainty.total > most


def depth_advice(facts: Facts) -> str:
    """Return the message on depths that calibrated cameras hardly determine, or not."""
    certainty = frames_of(facts.model).certainty
    if facts.model.camera_ == "affine" or known_depth(facts.model):
        return ""
    error = f"its expected error is {100 * certainty.total:.0f} % of the depth"
    state, result = "not determined", "Angles and proportions are withheld"
    if certainty.determined:
        error += f", and over {100 * LARGEST_SHARE:.0f} % in a third of such tests"
        state, result = "doubtful", "Compare angles and proportions with known ones"
    text = f"the depth of the shapes is {state}: {error}"
    if facts.bent:
        return f"{text}. The outliers may be the reason"
    why, lacking = "parts of the points lead to different depths", "more points"
    if certainty.deformation > LARGEST_SHARE**2:
        why = "deformation explains the images as well as rotations do"
        lacking = "the objects also from further sides, or turning further"
    return (
        f"{text}, because {why}. {result}. Record {lacking}"
        f'{facts.compare}. See "How reliable is the depth?" in the documentation'
    )


def gross_residuals(distance: NDArray | None) -> tuple[float, float, NDArray]:
    """Return the shares of gross residuals, and their rows and points.

    The shares are those of the points, and of the squares of all residuals.

    The outliers (n_outliers, 2) are sorted, the largest first. The scale is the median
    residual. It is larger for points and frames with a larger median of their own,
    which the model fits badly as a whole.
    """
    none = np.empty((0, 2), dtype=np.intp)
    if distance is None or not (finite := np.isfinite(distance)).any():
        return np.nan, np.nan, none
    median = float(np.median(distance[finite]))
    if not median > 0:
        return 0.0, 0.0, none
    limit = GROSS * median / MEDIAN_DISTANCE
    found = np.argwhere(finite & (distance > limit))
    relative = distance[tuple(found.T)]
    for axis, numbers in enumerate(found.T):  # medians of few rows and points
        some, places = np.unique(numbers, return_inverse=True)
        own = np.nanmedian(distance.take(some, axis), axis=1 - axis)
        relative = relative / np.maximum(1.0, own / median)[places]
    found, relative = found[relative > limit], relative[relative > limit]
    order = np.argsort(-relative, kind="stable")
    energy = np.sum(distance[tuple(found.T)] ** 2) / np.sum(distance[finite] ** 2)
    return len(found) / np.count_nonzero(finite), float(energy), found[order]


def camera_meaning(ratio: float) -> str:
    """Return the meaning of `camera_noise_ratio_`, in a sentence."""
    if np.isnan(ratio):
        return "not known: it was not measured"
    stretched = "the images were stretched, or there are far too few basis shapes"
    what = f"the cameras are probably not calibrated: {stretched}"
    if ratio < OTHER_CAMERAS:
        reasons = "too few basis shapes, perspective, or slightly stretched images"
        what = f"affine cameras explain more than calibrated ones, because of {reasons}"
    if ratio < SAME_NOISE:
        what = "calibrated cameras explain the table as well as affine ones"
    return f"{what} (noise variance {ratio:#.3g} times that of affine cameras)"


# Least share of the area between two directions in the image, relative to the largest
# ones of the table, of a row whose side is known: docs/benchmarks/README.md,
# "Thresholds".
LEAST_AREA = 0.5
# Largest `prior_std_` of people and annotators, on the same page.
LARGEST_WIDTH = 0.2


def warn_after_fit(
    model: Any, prior: Any, motion: NDArray, left_out: tuple[NDArray, NDArray] | None
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
    facts = Facts(model) if left_out is None else facts_of_rows(model, *left_out)
    advice = ". ".join(filter(None, (outlier_advice(facts), depth_advice(facts))))
    for text in filter(None, (message, advice)):
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
    with np.errstate(invalid="ignore"):  # images without extent have no side
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
        ends = layout.left_right.T, np.transpose(layout.up)
        return np.array([np.mean(shape[b] - shape[a], axis=0) for a, b in ends])
    sights = None if prior is None else getattr(prior, "motion_", None)
    if sights is None:
        return None
    sights = full_rotations(sights)[0][:, 2]
    sights = sights[np.isfinite(sights[:, 0])]
    view = prior.reference_motion_ / np.linalg.norm(prior.reference_motion_)
    return view * [[1], [-1]] if (sights @ np.cross(*view) > 0).all() else None
