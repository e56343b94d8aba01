"""Layouts of hands, of bodies and of both with the face."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

from isa_nrsfm.skeletons._faces import IBUG_68
from isa_nrsfm.skeletons._skeleton import named_skeleton, run, sides_of_names

_BOTH = ("left", "right")
_TOES = ("big_toe", "small_toe", "heel")


def _each(firsts: Iterable[str], seconds: Sequence[str]) -> tuple[str, ...]:
    """Return all pairs of words as names, one first word after the other."""
    return tuple(f"{first}_{second}" for first in firsts for second in seconds)


def _of_sides(parts: Iterable[str], sides: Sequence[str] = _BOTH) -> tuple[str, ...]:
    """Return parts on the sides as names, one part after the other."""
    return tuple(f"{side}_{part}" for part in parts for side in sides)


_BODY = partial(named_skeleton, kind="body")

_HAND_NAMES = (
    "wrist",
    *_each(["thumb"], ("cmc", "mcp", "ip", "tip")),
    *_each(
        ("index_finger", "middle_finger", "ring_finger", "pinky"),
        ("mcp", "pip", "dip", "tip"),
    ),
)
HAND_21 = named_skeleton(
    "hand-21",
    _HAND_NAMES,
    kind="hand",
    curves=(
        run(0, 4),  # thumb
        *(run(first, first + 3) for first in (5, 9, 13, 17)),  # fingers
        (0, 5, 9, 13, 17, 0),  # palm
    ),
    source="T. Simon et al., Hand Keypoint Detection in Single Images using Multiview "
    "Bootstrapping, CVPR 2017; F. Zhang et al., MediaPipe Hands, 2020; "
    "https://github.com/google-ai-edge/mediapipe, "
    "mediapipe/python/solutions/hands_connections.py",
    # A table of one hand does not determine the side that is seen, nor which hand.
    up=((0, 9),),
)


_ARM, _LEG = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")
_COCO_NAMES = ("nose", *_of_sides(("eye", "ear", *_ARM, *_LEG)))
COCO_17 = _BODY(
    "coco-17",
    _COCO_NAMES,
    curves=(
        *((3, 1, 0, 2, 4), (1, 2)),  # ears, eyes and nose
        *((3, 5), (4, 6)),  # ears to shoulders
        (5, 6, 12, 11, 5),  # trunk
        *((5, 7, 9), (6, 8, 10)),  # arms
        *((11, 13, 15), (12, 14, 16)),  # legs
    ),
    source="T.-Y. Lin et al., Microsoft COCO: Common Objects in Context, ECCV 2014; "
    "https://cocodataset.org/#format-data, "
    "annotations/person_keypoints_val2017.json",
    up=((11, 5), (12, 6)),
    front=((3, 0), (4, 0)),
    across=((6, 5), (12, 11)),
)

_RIGHT_FIRST = ("right", "left")
_H36M_NAMES = (
    *("pelvis", *_each(_RIGHT_FIRST, ("hip", "knee", "foot"))),
    *("spine", "thorax", "nose", "head", *_each(_BOTH, _ARM)),
)
H36M_17 = _BODY(
    "h36m-17",
    _H36M_NAMES,
    curves=(
        (0, 7, 8, 9, 10),  # spine and head
        *((0, 1, 2, 3), (0, 4, 5, 6)),  # legs
        *((8, 11, 12, 13), (8, 14, 15, 16)),  # arms
    ),
    source="C. Ionescu et al., Human3.6M, IEEE Transactions on Pattern Analysis and "
    "Machine Intelligence 36, 2014; the 17 joints as of J. Martinez et al., A "
    "Simple yet Effective Baseline for 3D Human Pose Estimation, ICCV 2017, and "
    "https://github.com/facebookresearch/VideoPose3D",
    up=((0, 8),),
    # The nose is in front of the line from the thorax to the top of the head.
    front=((8, 9), (10, 9)),
    across=((14, 11), (1, 4)),
)

_BODY_25_NAMES = (
    *("nose", "neck", *_each(_RIGHT_FIRST, _ARM)),
    *("mid_hip", *_each(_RIGHT_FIRST, _LEG)),
    *(*_of_sides(("eye", "ear"), _RIGHT_FIRST), *_each(_BOTH, _TOES)),
)
BODY_25 = _BODY(
    "body-25",
    _BODY_25_NAMES,
    curves=(
        (17, 15, 0, 16, 18),  # ears, eyes and nose
        (0, 1, 8),  # neck and trunk
        *((1, 2, 3, 4), (1, 5, 6, 7)),  # arms
        *((8, 9, 10, 11, 22, 23), (11, 24)),  # right leg and foot
        *((8, 12, 13, 14, 19, 20), (14, 21)),  # left leg and foot
    ),
    source="Z. Cao et al., OpenPose, IEEE Transactions on Pattern Analysis and Machine "
    "Intelligence 43, 2021; "
    "https://github.com/CMU-Perceptual-Computing-Lab/openpose, doc/02_output.md",
    up=((8, 1),),
    front=((17, 0), (18, 0), (21, 19), (24, 22)),
    across=((2, 5), (9, 12)),
)

_POSE_NAMES = (
    *("nose", "left_eye_inner", "left_eye", "left_eye_outer"),
    *("right_eye_inner", "right_eye", "right_eye_outer"),
    *("left_ear", "right_ear", "mouth_left", "mouth_right"),
    *_of_sides((*_ARM, "pinky", "index", "thumb", *_LEG, "heel", "foot_index")),
)
POSE_33 = _BODY(
    "mediapipe-pose-33",
    _POSE_NAMES,
    curves=(
        (7, 3, 2, 1, 0, 4, 5, 6, 8),  # ears, eyes and nose
        (9, 10),  # mouth
        (11, 12, 24, 23, 11),  # trunk
        *((11, 13, 15, 17, 19, 15, 21), (12, 14, 16, 18, 20, 16, 22)),  # arms, hands
        *((23, 25, 27, 29, 31, 27), (24, 26, 28, 30, 32, 28)),  # legs and feet
    ),
    source="V. Bazarevsky et al., BlazePose: On-device Real-time Body Pose Tracking, "
    "2020; https://github.com/google-ai-edge/mediapipe, "
    "mediapipe/python/solutions/pose_connections.py",
    up=((23, 11), (24, 12)),
    front=((7, 0), (8, 0), (29, 31), (30, 32)),
    across=((12, 11), (24, 23)),
)

_FACE, _LEFT_HAND, _RIGHT_HAND = 23, 91, 112
_COCO_FINGERS = ("thumb", "forefinger", "middle_finger", "ring_finger", "pinky_finger")
_COCO_HAND = ("hand_root", *(f"{f}{j}" for f in _COCO_FINGERS for j in (1, 2, 3, 4)))
_WHOLE_NAMES = (
    *(*_COCO_NAMES, *_each(_BOTH, _TOES)),
    *(f"face-{j}" for j in range(68)),
    *_each(_BOTH, _COCO_HAND),
)
_LEFT, _RIGHT = sides_of_names(_WHOLE_NAMES)


def _shifted(curve: Iterable[int], offset: int = _FACE) -> tuple[int, ...]:
    """Return points whose indices are larger by an offset."""
    return tuple(j + offset for j in curve)


WHOLE_BODY_133 = replace(
    COCO_17,
    name="coco-wholebody-133",
    kind="whole body",
    n_points=133,
    curves=(
        *COCO_17.curves,
        *((19, 15, 17, 18), (22, 16, 20, 21)),  # feet
        *map(_shifted, IBUG_68.curves),
        *(_shifted(curve, _LEFT_HAND) for curve in HAND_21.curves),
        *(_shifted(curve, _RIGHT_HAND) for curve in HAND_21.curves),
        *((9, _LEFT_HAND), (10, _RIGHT_HAND)),  # wrists
    ),
    source="S. Jin et al., Whole-Body Human Pose Estimation in the Wild, ECCV 2020; "
    "https://github.com/jin-s13/COCO-WholeBody; names: "
    "https://github.com/open-mmlab/mmpose, "
    "configs/_base_/datasets/coco_wholebody.py",
    point_names=_WHOLE_NAMES,
    left=(*_LEFT, *_shifted(IBUG_68.left)),
    right=(*_RIGHT, *_shifted(IBUG_68.right)),
    front=(*COCO_17.front, (19, 17), (22, 20)),
    contour=_shifted(IBUG_68.contour),
)

BODIES = (HAND_21, COCO_17, H36M_17, BODY_25, POSE_33, WHOLE_BODY_133)
