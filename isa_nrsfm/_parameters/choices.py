"""The values of text parameters of `AffineNRSfM`, each default first.

No imports: the help of the command line must not wait for NumPy or scikit-learn.
"""

BLOCK_RECOVERIES = ("generalized_eigen", "eigen", "irls")
REFINEMENTS = ("joint", "consensus", "alternating")
# Refinements that begin with the joint fit.
JOINT_REFINEMENTS = ("joint", "consensus")
CALIBRATED_CAMERAS = ("weak_perspective", "orthographic")
CAMERA_NAMES = ("affine", *CALIBRATED_CAMERAS, "perspective")
# Shapes that move away from those of a prior: the mean shape, or all.
ADAPTED = ("mean", "shapes")
INDEPENDENCE = ("shapes", "coefficients")
LOSSES = ("linear", "huber", "cauchy")
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
