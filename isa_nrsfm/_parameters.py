"""Parameters: their values, their names in messages, and what they need of others.

The help of the command line must not wait for NumPy or scikit-learn.
"""

from collections.abc import Callable, Mapping
from contextvars import ContextVar
from typing import Any, Literal, get_args

BlockRecovery = Literal["generalized_eigen", "irls"]
Refinement = Literal["joint", "consensus", "alternating"]
CalibratedCamera = Literal["weak_perspective", "orthographic"]
Camera = Literal["affine", CalibratedCamera, "perspective"]
Independence = Literal["shapes", "coefficients"]
Loss = Literal["linear", "huber", "cauchy"]
Axes = Literal["object", "camera"]

BLOCK_RECOVERIES: tuple[BlockRecovery, ...] = get_args(BlockRecovery)
REFINEMENTS: tuple[Refinement, ...] = get_args(Refinement)
# Refinements that begin with the joint fit.
JOINT_REFINEMENTS = ("joint", "consensus")
CALIBRATED_CAMERAS: tuple[CalibratedCamera, ...] = get_args(CalibratedCamera)
CAMERA_NAMES: tuple[Camera, ...] = get_args(Camera)
INDEPENDENCE: tuple[Independence, ...] = get_args(Independence)
LOSSES: tuple[Loss, ...] = get_args(Loss)
AXES: tuple[Axes, ...] = get_args(Axes)
# Sets of points in the files of OpenPose.
OPENPOSE_PARTS = ("pose", "face", "hand_left", "hand_right")
# Parts of whole bodies in the files of COCO and MMPose.
WHOLE_PARTS = ("body", "feet", "face", "left_hand", "right_hand", "all")
# The layouts in `isa_nrsfm.skeletons.SKELETONS`, in that order.
SKELETON_NAMES = tuple(
    "ibug-68 ibug-51 xm2vts-68 xm2vts-53 muct-76 muct-61 wflw-98 wflw-65 "
    "mediapipe-face-468 mediapipe-face-478 hand-21 coco-17 h36m-17 body-25 "
    "mediapipe-pose-33 coco-wholebody-133".split()
)
# Layouts with a face prior, and their points in its file.
FACE_PRIORS = {"ibug-68": range(68), "ibug-51": range(17, 68)}
FACE_PRIORS |= {"xm2vts-68": range(68, 136), "xm2vts-53": range(83, 136)}
FACE_PRIORS |= {"muct-76": range(68, 144), "muct-61": range(83, 144)}


def in_python(name: str, *values: Any) -> str:
    """Return a parameter, and its values if there are any, as an argument of Python."""
    return f"{name}={' or '.join(map(repr, values))}" if values else name


# The command line sets its own way for the time of a command.
WRITTEN: ContextVar[Callable[..., str]] = ContextVar("WRITTEN", default=in_python)


def named(name: str, *values: Any) -> str:
    """
    Return a parameter, and its values if there are any, as the user writes it.

    >>> from isa_nrsfm._parameters import named
    >>> named("columns"), named("camera", "affine")
    ('columns', "camera='affine'")
    """
    return WRITTEN.get()(name, *values)


_JOINT, _CALIBRATED = ("refinement", JOINT_REFINEMENTS), ("camera", CAMERA_NAMES[1:])
# Settings (of no values: any but None and False), the setting that they need, its
# values, and why.
REQUIREMENTS: tuple[tuple[str, tuple[str, ...], str, tuple[str, ...], str], ...] = (
    ("n_components", ("auto",), *_JOINT, ""),
    ("loss", LOSSES[1:], *_JOINT, ""),
    ("independence", ("coefficients",), *_JOINT, ""),
    ("std", (), *_JOINT, ""),
    ("camera", ("perspective",), *_JOINT, "whose fits find the depths of the points"),
    ("refinement", ("consensus",), *_CALIBRATED, "which give depths a common unit"),
    ("remove_pose", (), *_CALIBRATED, "which have a yaw"),
    ("focal_length", (), *_CALIBRATED, "which have axes"),
    ("principal_point", (), *_CALIBRATED, "which have axes"),
    ("prior", (), *_CALIBRATED, "whose depths are those of the prior"),
    ("prior", (), "refinement", ("joint",), "which has a likelihood for it"),
    ("point_weight", (), "refinement", ("joint",), "the only fit with weights"),
    ("point_weight", (), "loss", ("linear",), "as others find weights of their own"),
)


def check_requirements(given: Mapping[str, Any]) -> None:
    """Raise if a setting needs another value of another one that is given."""
    for name, values, other, allowed, why in REQUIREMENTS:
        value = given.get(name)
        is_set = value in values if values else value is not None and value is not False
        if is_set and given.get(other, allowed[0]) not in allowed:
            because = f", {why}" if why else ""
            raise ValueError(
                f"{named(name, *[value][: len(values)])} needs {named(other, *allowed)}"
                f"{because}; got {named(other, given[other])}"
            )
