"""Layouts of hands, of bodies and of both with the face."""

from dataclasses import replace
from itertools import chain

from isa_nrsfm.skeletons._faces import IBUG_68
from isa_nrsfm.skeletons._skeleton import Skeleton, run, shifted

_FINGERS = ("index_finger", "middle_finger", "ring_finger", "pinky")
HAND_21 = Skeleton(
    name="hand-21",
    kind="hand",
    n_points=21,
    curves=(
        run(0, 4),  # thumb
        *(run(first, first + 3) for first in (5, 9, 13, 17)),  # fingers
        (0, 5, 9, 13, 17, 0),  # palm
    ),
    source=(
        "T. Simon et al., Hand Keypoint Detection in Single Images using Multiview "
        "Bootstrapping, CVPR 2017; F. Zhang et al., MediaPipe Hands, 2020; "
        "https://github.com/google-ai-edge/mediapipe, "
        "mediapipe/python/solutions/hands_connections.py"
    ),
    point_names=(
        "wrist",
        *(f"thumb_{joint}" for joint in ("cmc", "mcp", "ip", "tip")),
        *(f"{f}_{joint}" for f in _FINGERS for joint in ("mcp", "pip", "dip", "tip")),
    ),
    # A table of one hand does not determine the side that is seen, nor which hand.
    up=((0, 9),),
)


def _sides(names: tuple[str, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the points of the left side and, in the same order, of the right."""
    left = [name for name in names if name.startswith("left_")]
    right = [f"right_{name.removeprefix('left_')}" for name in left]
    return tuple(map(names.index, left)), tuple(map(names.index, right))


_COCO_NAMES = (
    "nose",
    *(
        f"{side}_{part}"
        for part in ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in ("left", "right")
    ),
)
_LEFT, _RIGHT = _sides(_COCO_NAMES)
COCO_17 = Skeleton(
    name="coco-17",
    kind="body",
    n_points=17,
    curves=(
        (3, 1, 0, 2, 4),  # ears, eyes and nose
        (1, 2),
        (3, 5),
        (4, 6),
        (5, 6, 12, 11, 5),  # trunk
        (5, 7, 9),  # arms
        (6, 8, 10),
        (11, 13, 15),  # legs
        (12, 14, 16),
    ),
    source=(
        "T.-Y. Lin et al., Microsoft COCO: Common Objects in Context, ECCV 2014; "
        "https://cocodataset.org/#format-data, "
        "annotations/person_keypoints_val2017.json"
    ),
    point_names=_COCO_NAMES,
    left=_LEFT,
    right=_RIGHT,
    up=((11, 5), (12, 6)),
    front=((3, 0), (4, 0)),
    across=((6, 5), (12, 11)),
)

_H36M_NAMES = (
    "pelvis",
    *(f"{side}_{j}" for side in ("right", "left") for j in ("hip", "knee", "foot")),
    *("spine", "thorax", "nose", "head"),
    *(
        f"{side}_{j}"
        for side in ("left", "right")
        for j in ("shoulder", "elbow", "wrist")
    ),
)
_LEFT, _RIGHT = _sides(_H36M_NAMES)
H36M_17 = Skeleton(
    name="h36m-17",
    kind="body",
    n_points=17,
    curves=(
        (0, 7, 8, 9, 10),  # spine and head
        (0, 1, 2, 3),  # legs
        (0, 4, 5, 6),
        (8, 11, 12, 13),  # arms
        (8, 14, 15, 16),
    ),
    source=(
        "C. Ionescu et al., Human3.6M, IEEE Transactions on Pattern Analysis and "
        "Machine Intelligence 36, 2014; the 17 joints as of J. Martinez et al., A "
        "Simple yet Effective Baseline for 3D Human Pose Estimation, ICCV 2017, and "
        "https://github.com/facebookresearch/VideoPose3D"
    ),
    point_names=_H36M_NAMES,
    left=_LEFT,
    right=_RIGHT,
    up=((0, 8),),
    # The nose is in front of the line from the thorax to the top of the head.
    front=((8, 9), (10, 9)),
    across=((14, 11), (1, 4)),
)

_BODY_25_NAMES = (
    *("nose", "neck"),
    *(
        f"{side}_{j}"
        for side in ("right", "left")
        for j in ("shoulder", "elbow", "wrist")
    ),
    "mid_hip",
    *(f"{side}_{j}" for side in ("right", "left") for j in ("hip", "knee", "ankle")),
    *(f"{side}_{part}" for part in ("eye", "ear") for side in ("right", "left")),
    *(
        f"{side}_{part}"
        for side in ("left", "right")
        for part in ("big_toe", "small_toe", "heel")
    ),
)
_LEFT, _RIGHT = _sides(_BODY_25_NAMES)
BODY_25 = Skeleton(
    name="body-25",
    kind="body",
    n_points=25,
    curves=(
        (17, 15, 0, 16, 18),  # ears, eyes and nose
        (0, 1, 8),  # neck and trunk
        (1, 2, 3, 4),  # arms
        (1, 5, 6, 7),
        (8, 9, 10, 11, 22, 23),  # legs and feet
        (11, 24),
        (8, 12, 13, 14, 19, 20),
        (14, 21),
    ),
    source=(
        "Z. Cao et al., OpenPose, IEEE Transactions on Pattern Analysis and Machine "
        "Intelligence 43, 2021; "
        "https://github.com/CMU-Perceptual-Computing-Lab/openpose, doc/02_output.md"
    ),
    point_names=_BODY_25_NAMES,
    left=_LEFT,
    right=_RIGHT,
    up=((8, 1),),
    front=((17, 0), (18, 0), (21, 19), (24, 22)),
    across=((2, 5), (9, 12)),
)

_POSE_PARTS = (
    *("shoulder", "elbow", "wrist", "pinky", "index", "thumb"),
    *("hip", "knee", "ankle", "heel", "foot_index"),
)
_POSE_NAMES = (
    "nose",
    *(
        f"{side}_eye{part}"
        for side in ("left", "right")
        for part in ("_inner", "", "_outer")
    ),
    *("left_ear", "right_ear", "mouth_left", "mouth_right"),
    *(f"{side}_{part}" for part in _POSE_PARTS for side in ("left", "right")),
)
_LEFT, _RIGHT = _sides(_POSE_NAMES)
POSE_33 = Skeleton(
    name="mediapipe-pose-33",
    kind="body",
    n_points=33,
    curves=(
        (7, 3, 2, 1, 0, 4, 5, 6, 8),  # ears, eyes and nose
        (9, 10),  # mouth
        (11, 12, 24, 23, 11),  # trunk
        (11, 13, 15, 17, 19, 15, 21),  # arms and hands
        (12, 14, 16, 18, 20, 16, 22),
        (23, 25, 27, 29, 31, 27),  # legs and feet
        (24, 26, 28, 30, 32, 28),
    ),
    source=(
        "V. Bazarevsky et al., BlazePose: On-device Real-time Body Pose Tracking, "
        "2020; https://github.com/google-ai-edge/mediapipe, "
        "mediapipe/python/solutions/pose_connections.py"
    ),
    point_names=_POSE_NAMES,
    left=(*_LEFT, 9),
    right=(*_RIGHT, 10),
    up=((23, 11), (24, 12)),
    front=((7, 0), (8, 0), (29, 31), (30, 32)),
    across=((12, 11), (24, 23)),
)

_FACE, _LEFT_HAND, _RIGHT_HAND = 23, 91, 112
_COCO_FINGERS = ("thumb", "forefinger", "middle_finger", "ring_finger", "pinky_finger")
WHOLE_BODY_133 = replace(
    COCO_17,
    name="coco-wholebody-133",
    kind="whole body",
    n_points=133,
    curves=(
        *COCO_17.curves,
        (19, 15, 17, 18),  # feet
        (22, 16, 20, 21),
        *shifted(IBUG_68.curves, _FACE),
        *shifted(HAND_21.curves, _LEFT_HAND),
        *shifted(HAND_21.curves, _RIGHT_HAND),
        (9, _LEFT_HAND),
        (10, _RIGHT_HAND),
    ),
    source=(
        "S. Jin et al., Whole-Body Human Pose Estimation in the Wild, ECCV 2020; "
        "https://github.com/jin-s13/COCO-WholeBody; names: "
        "https://github.com/open-mmlab/mmpose, "
        "configs/_base_/datasets/coco_wholebody.py"
    ),
    point_names=(
        *_COCO_NAMES,
        *(
            f"{side}_{part}"
            for side in ("left", "right")
            for part in ("big_toe", "small_toe", "heel")
        ),
        *(f"face-{j}" for j in range(68)),
        *chain.from_iterable(
            (
                f"{side}_hand_root",
                *(f"{side}_{f}{j}" for f in _COCO_FINGERS for j in (1, 2, 3, 4)),
            )
            for side in ("left", "right")
        ),
    ),
    left=(
        *COCO_17.left,
        *range(17, 20),
        *(j + _FACE for j in IBUG_68.left),
        *range(_LEFT_HAND, _RIGHT_HAND),
    ),
    right=(
        *COCO_17.right,
        *range(20, 23),
        *(j + _FACE for j in IBUG_68.right),
        *range(_RIGHT_HAND, 133),
    ),
    front=(*COCO_17.front, (19, 17), (22, 20)),
    contour=tuple(j + _FACE for j in IBUG_68.contour),
)

BODIES = (HAND_21, COCO_17, H36M_17, BODY_25, POSE_33, WHOLE_BODY_133)
