"""Layouts of faces.

In all of them the lowest indices of a curve that goes across the face are on the side
of the person's right eye, which an image shows on its left.
"""

from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np

from isa_nrsfm.skeletons._skeleton import Pairs, Skeleton, listed, run

_FACE = partial(Skeleton, kind="face")

IBUG_68 = _FACE(
    name="ibug-68",
    n_points=68,
    curves=(
        run(0, 16),  # jaw
        *(run(17, 21), run(22, 26)),  # brows
        run(27, 30),  # bridge of the nose
        run(31, 35),  # nostrils
        *(run(36, 41, closed=True), run(42, 47, closed=True)),  # eyes
        *(run(48, 59, closed=True), run(60, 67, closed=True)),  # outer and inner lips
    ),
    source="C. Sagonas et al., 300 Faces in-the-Wild Challenge, ICCV Workshops 2013; "
    "https://ibug.doc.ic.ac.uk/resources/facial-point-annotations/",
    right=listed(np.r_[0:8, 17:22, 31, 32, 36:42, 48:51, 58:62, 67]),
    left=listed(
        np.r_[16:8:-1, 26:21:-1, 35, 34, 45:41:-1, 47, 46, 54:51:-1, 56, 55, 64, 63, 65]
    ),
    up=((8, 27),),
    front=((0, 30), (16, 30)),
    contour=run(0, 16),
)


def _without_contour(face: Skeleton, name: str, up: Pairs, front: Pairs) -> Skeleton:
    """Return a face without its contour, with pairs of points of the whole face."""
    inner = replace(face, up=up, front=front).subset(face.inner)
    return replace(inner, name=name)


IBUG_51 = _without_contour(
    IBUG_68, "ibug-51", up=((57, 27),), front=((36, 30), (45, 30))
)

# Points 31 and 36 are the pupils, 46, 47 and 67 nostrils and tip of the nose, 66 the
# middle of the mouth: drawn, not joined.
_XM2VTS_EYES = (run(27, 30, closed=True), run(32, 35, closed=True))
XM2VTS_68 = _FACE(
    name="xm2vts-68",
    n_points=68,
    curves=(
        run(0, 14),  # jaw
        *(run(15, 20, closed=True), run(21, 26, closed=True)),  # brows
        *_XM2VTS_EYES,
        run(37, 45),  # nose
        run(48, 59, closed=True),  # outer lips
        *((48, *run(60, 62), 54), (54, *run(63, 65), 48)),  # inner edges of the lips
    ),
    source="K. Messer et al., XM2VTSDB: The Extended M2VTS Database, AVBPA 1999; "
    "S. Milborrow et al., The MUCT Landmarked Face Database, PRASA 2010, "
    "http://www.milbo.org/muct",
    right=listed(np.r_[0:7, 21:32, 37:41, 46, 48:51, 59, 58, 60, 65]),
    left=listed(np.r_[14:7:-1, 15:21, 32:37, 45:41:-1, 47, 54:51:-1, 55, 56, 62, 63]),
    up=((7, 37), (7, 45)),
    front=((0, 67), (14, 67)),
    contour=run(0, 14),
)
# The lower lip and the outer corners of the eyes in place of the jaw.
_XM2VTS_INNER: dict[str, Pairs] = {
    "up": ((57, 37), (57, 45)),
    "front": ((27, 67), (32, 67)),
}
XM2VTS_53 = _without_contour(XM2VTS_68, "xm2vts-53", **_XM2VTS_INNER)

# Eight more points, between the points of the eyelids.
_MUCT_EYES = (
    (27, 68, 28, 69, 29, 70, 30, 71, 27),
    (32, 72, 33, 73, 34, 74, 35, 75, 32),
)
MUCT_76 = replace(
    XM2VTS_68,
    name="muct-76",
    n_points=76,
    curves=(*(c for c in XM2VTS_68.curves if c not in _XM2VTS_EYES), *_MUCT_EYES),
    source="S. Milborrow, J. Morkel, F. Nicolls, The MUCT Landmarked Face Database, "
    "PRASA 2010, http://www.milbo.org/muct; the order round the eyes: "
    "https://github.com/auduno/clmtrackr",
    right=(*XM2VTS_68.right, *range(68, 72)),
    left=(*XM2VTS_68.left, *range(72, 76)),
)
MUCT_61 = _without_contour(MUCT_76, "muct-61", **_XM2VTS_INNER)

WFLW_98 = _FACE(
    name="wflw-98",
    n_points=98,
    curves=(
        run(0, 32),  # jaw
        *(run(33, 41, closed=True), run(42, 50, closed=True)),  # brows
        run(51, 54),  # bridge of the nose
        run(55, 59),  # nostrils
        *(run(60, 67, closed=True), run(68, 75, closed=True)),  # eyes
        *(run(76, 87, closed=True), run(88, 95, closed=True)),  # outer and inner lips
    ),
    source="W. Wu et al., Look at Boundary: A Boundary-Aware Face Alignment Algorithm, "
    "CVPR 2018, https://wywu.github.io/projects/LAB/WFLW.html; mirror images: "
    "https://github.com/open-mmlab/mmpose, configs/_base_/datasets/wflw.py",
    right=listed(np.r_[0:16, 33:42, 55, 56, 60:68, 76:79, 87, 86, 88, 89, 95, 96]),
    left=(
        *listed(np.r_[32:16:-1, 46:41:-1, 50:46:-1, 59, 58, 72:67:-1, 75:72:-1]),
        *listed(np.r_[82:79:-1, 83, 84, 92, 91, 93, 97]),
    ),
    up=((16, 51),),
    front=((0, 54), (32, 54)),
    contour=run(0, 32),
)
WFLW_65 = _without_contour(
    WFLW_98, "wflw-65", up=((85, 51),), front=((60, 54), (72, 54))
)

# The contours of the mesh: the right side, and in the same order the left side.
_RIGHT = (
    (33, 7, 163, 144, 145, 153, 154, 155, 133),  # lower and upper lid
    (33, 246, 161, 160, 159, 158, 157, 173, 133),
    (46, 53, 52, 65, 55),  # lower and upper edge of the brow
    (70, 63, 105, 66, 107),
)
_LEFT = (
    (263, 249, 390, 373, 374, 380, 381, 382, 362),
    (263, 466, 388, 387, 386, 385, 384, 398, 362),
    (276, 283, 282, 295, 285),
    (300, 293, 334, 296, 336),
)
# Halves of curves across the face, from the middle to the right, and to the left.
_RIGHT_HALVES = (
    # The oval from the forehead to the chin.
    (
        *(10, 109, 67, 103, 54, 21, 162, 127, 234),
        *(93, 132, 58, 172, 136, 150, 149, 176, 148, 152),
    ),
    (17, 84, 181, 91, 146, 61),  # lips: outer edge below and above, inner edge
    (0, 37, 39, 40, 185, 61),
    (14, 87, 178, 88, 95, 78),
    (13, 82, 81, 80, 191, 78),
    (2, 97, 98),  # nostrils
)
_LEFT_HALVES = (
    (
        *(10, 338, 297, 332, 284, 251, 389, 356, 454),
        *(323, 361, 288, 397, 365, 379, 378, 400, 377, 152),
    ),
    (17, 314, 405, 321, 375, 291),
    (0, 267, 269, 270, 409, 291),
    (14, 317, 402, 318, 324, 308),
    (13, 312, 311, 310, 415, 308),
    (2, 326, 327),
)
_BRIDGE = (168, 6, 197, 195, 5, 4, 1, 19, 94, 2)
_SIDES = chain(*_RIGHT, *_RIGHT_HALVES), chain(*_LEFT, *_LEFT_HALVES)
_MIRROR = {right: left for right, left in zip(*_SIDES, strict=True) if right != left}
MESH_468 = _FACE(
    name="mediapipe-face-468",
    n_points=468,
    curves=(*_RIGHT, *_LEFT, *_RIGHT_HALVES, *_LEFT_HALVES, _BRIDGE),
    source="Y. Kartynnik et al., Real-time Facial Surface Geometry from Monocular "
    "Video on Mobile GPUs, 2019; contours: https://github.com/google-ai-edge/mediapipe"
    ", mediapipe/python/solutions/face_mesh_connections.py",
    right=tuple(_MIRROR),
    left=tuple(_MIRROR.values()),
    up=((152, 168),),
    front=((234, 1), (454, 1)),
)

# The irises, with their centres 468 and 473.
MESH_478 = replace(
    MESH_468,
    name="mediapipe-face-478",
    n_points=478,
    curves=(
        *MESH_468.curves,
        *(run(469, 472, closed=True), run(474, 477, closed=True)),
    ),
    right=(*MESH_468.right, 468),
    left=(*MESH_468.left, 473),
)

FACES = (
    *(IBUG_68, IBUG_51, XM2VTS_68, XM2VTS_53, MUCT_76, MUCT_61, WFLW_98, WFLW_65),
    *(MESH_468, MESH_478),
)
