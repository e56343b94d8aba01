"""Advice on a fit: from measured facts to at most three messages that agree."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.models import LARGEST_SHARE, DepthCertainty
from isa_nrsfm._joint.uncertainty import n_reliable

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
    "x and y have the same unit, unlike shares of the width and height of an image"
)
# Share of points with gross residuals above which a table has outliers. Without
# outliers the share is at most 0.02 %: generated faces, bodies and hands, captured
# motion, photos of faces, K = 3 and 9. With one wrong point in a thousand, at half the
# size of a face, it is 0.06 to 0.13 %.
MOST_GROSS = 5e-4
MOST_MESSAGES = 3


class Facts(NamedTuple):
    """
    What is known of a joint fit.

    Attributes
    ----------
    camera, loss : str
        Those of the fit.
    consensus, auto : bool
        Whether groups of points were fitted, and whether the fit has chosen the number
        of basis shapes.
    certainty : DepthCertainty
        Errors of the depths.
    reliability, noise_ratio : ndarray of shape (n_components,), float
        `reliability_` and `camera_noise_ratio_`; NaN if it was not measured.
    deviation : float
        Largest standard deviation of the weakly determined parts of the basis shapes.
    outlier_share : float
        As in `Diagnostics`.
    outliers, few, pose : str
        Descriptions of outliers, of coefficients that a few frames determine, and of
        those that the pose predicts; empty if there are none.
    """

    camera: str
    loss: str
    consensus: bool
    auto: bool
    certainty: DepthCertainty
    reliability: NDArray
    noise_ratio: float
    deviation: float = 0.0
    outlier_share: float = np.nan
    outliers: str = ""
    few: str = ""
    pose: str = ""

    @property
    def bent(self) -> bool:
        """Whether outliers have their full influence on the fit."""
        return self.loss == "linear" and self.outlier_share > MOST_GROSS

    @property
    def n_supported(self) -> int:
        """Number of basis shapes that the table supports.

        A consensus has many small components. Without those that are noise, the next
        smallest ones are.
        """
        supported = n_reliable(self.reliability)
        return len(self.reliability) if supported and self.consensus else supported


def facts_of(model: Any, **found: Any) -> Facts:
    """Return what the attributes of a joint fit tell, and what else was found."""
    frames = model._model.frames
    return Facts(
        model.camera_,
        frames.loss,
        model.refinement == "consensus",
        model.n_components == "auto",
        frames.certainty,
        model.reliability_,
        getattr(model, "camera_noise_ratio_", np.nan),
        **found,
    )


def advice(facts: Facts) -> tuple[str, ...]:
    """Return what happened, why, and what to do: the most important messages first."""
    depth, n_components = depth_advice(facts), len(facts.reliability)
    if facts.bent:  # outliers may cause all others
        bent = 'they bend the shapes. Use loss="cauchy", or correct them'
        messages = [f"{facts.outliers}: {bent}", depth]
    elif not facts.n_supported:
        messages = [depth, _of_rigid_objects(facts)]
    elif facts.n_supported < n_components:
        surplus = n_components - facts.n_supported
        text = (
            f"the table does not support n_components={n_components}: {surplus} "
            "direction(s) of the coefficients are probably noise. Use at most "
            f"n_components={facts.n_supported}"
        )
        messages = [depth, text, facts.pose]
    else:
        few = "Look for wrong landmarks in the frames with the largest coefficients"
        few = f"{facts.few}. {few}" if facts.few else ""
        cameras = "" if depth else _of_cameras(facts)
        # Wrong cameras look like coefficients that depend on the pose.
        pose = "" if cameras else facts.pose
        messages = [depth or cameras, _of_weak_parts(facts), few, pose]
    return tuple(filter(None, messages))[:MOST_MESSAGES]


def depth_advice(facts: Facts) -> str:
    """Return the message on depths that calibrated cameras do not determine."""
    certainty = facts.certainty
    if facts.camera == "affine" or certainty.determined:
        return ""
    text = (
        "the depth of the shapes is not determined: its expected error is "
        f"{100 * certainty.total:.0f} % of the depth"
    )
    if facts.bent:
        return f"{text}. The outliers may be the reason"
    most = max(facts.n_supported, 1)
    if certainty.deformation > LARGEST_SHARE**2:
        why = "deformation explains the images as well as rotations do"
        remedy = (
            "fit a table in which the objects turn further, and transform this one "
            "with that model"
        )
    else:
        why = "parts of the points lead to different depths"
        if most < len(facts.reliability):
            remedy = f"use at most n_components={most}"
        elif not facts.auto:
            remedy = (
                'use n_components="auto" and, if that does not suffice, '
                'refinement="consensus"'
            )
        elif not facts.consensus:
            remedy = 'use refinement="consensus"'
        else:
            remedy = "fit more points or further views"
        if facts.noise_ratio >= SAME_NOISE:
            remedy = f"make sure that {SAME_UNIT}, then {remedy}"
    return (
        f"{text}, because {why}. {remedy[0].upper()}{remedy[1:]}. If coefficients "
        'suffice, use affine cameras (camera="affine"). See "How reliable is the '
        'depth?" in the documentation'
    )


def _of_rigid_objects(facts: Facts) -> str:
    """Return the message on coefficients that are all noise."""
    text = (
        "no deformation was found beyond the noise: the object may be rigid. Do not "
        "interpret the coefficients"
    )
    if facts.loss == "linear" and np.isnan(facts.outlier_share):
        text += '. If some points are wrong (outliers), use loss="cauchy"'
    return text


def _of_cameras(facts: Facts) -> str:
    """Return the message on calibrated cameras that do not explain the images."""
    ratio = facts.noise_ratio
    if facts.camera == "affine" or not ratio >= SAME_NOISE:
        return ""
    if facts.auto or facts.consensus or ratio >= OTHER_CAMERAS:
        remedy = 'affine cameras (camera="affine")'
    else:
        remedy = 'more basis shapes (n_components="auto" finds how many)'
    return f"{camera_meaning(ratio)}. Make sure that {SAME_UNIT}, or use {remedy}"


def _of_weak_parts(facts: Facts) -> str:
    """Return the message on what affine cameras cannot separate from deformation."""
    if facts.camera != "affine" or not facts.deviation > LARGEST_DEVIATION:
        return ""
    return (
        "the basis shapes are uncertain by up to "
        f"{100 * facts.deviation:.2g} % of the mean shape: affine cameras absorb such "
        "deformation. Use more frames, best of objects that turn further"
    )


def camera_meaning(ratio: float) -> str:
    """Return the meaning of `camera_noise_ratio_`, in a sentence."""
    if np.isnan(ratio):
        return "not known: it was not measured"
    if ratio < SAME_NOISE:
        what = "calibrated cameras explain the table as well as affine ones"
    elif ratio < OTHER_CAMERAS:
        what = (
            "affine cameras explain more than calibrated ones: possible reasons are "
            "too few basis shapes, perspective, or slightly stretched images"
        )
    else:
        what = (
            "the cameras are probably not calibrated: the images were stretched, or "
            "there are far too few basis shapes"
        )
    return f"{what} (noise variance {ratio:#.3g} times that of affine cameras)"
