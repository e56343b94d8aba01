"""The types and values of text parameters of `AffineNRSfM`, each default first.

The help of the command line must not wait for NumPy or scikit-learn.
"""

from typing import Literal, get_args

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
