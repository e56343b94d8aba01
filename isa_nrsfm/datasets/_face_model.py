"""Define a symmetric 68-point face and its expressions.

Millimetres. The origin lies between the nose tip and the ears' plane, x points to the
right in the image, y down and z away from the camera: the nose tip has the smallest
z. Only the half on the left of the image (the subject's right) and the middle are
written down, at the indices of the iBUG-68 scheme; the other half is the mirror image.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm.skeletons import get_skeleton

N_POINTS = 68

# fmt: off
# Point: (x, y, z)
_NEUTRAL = {
    # jaw, from the ear to the chin
    0: (-72, -30, 71), 1: (-71.5, -12, 69), 2: (-69.5, 6, 65), 3: (-66, 24, 58),
    4: (-59, 41, 47), 5: (-48, 56, 32), 6: (-34, 68, 15), 7: (-17.5, 76, 3),
    8: (0, 79, -2),
    # brow, from its outer end to the inner end
    17: (-58, -46, 18), 18: (-50, -53.5, 7), 19: (-39, -56.5, -1),
    20: (-27, -55, -5.5), 21: (-15, -50.5, -7.5),
    # bridge and tip of the nose
    27: (0, -33, -5), 28: (0, -21.5, -11), 29: (0, -10, -17.5), 30: (0, 1, -23),
    # nostrils
    31: (-14.5, 10, -5), 32: (-7.5, 12.5, -9.5), 33: (0, 14, -12),
    # eye: outer corner, upper lid, inner corner, lower lid
    36: (-46, -33, 11), 37: (-38.5, -38, 4.5), 38: (-27.5, -38, 3),
    39: (-19, -31.5, 6), 40: (-27.5, -28.5, 4.5), 41: (-38.5, -28.5, 6),
    # outer lips: corner, upper lip; lower lip from the middle
    48: (-26, 38, 4), 49: (-16.5, 32.5, -5), 50: (-6.5, 29, -10.5),
    51: (0, 30.5, -11.5), 57: (0, 49, -9), 58: (-8.5, 48, -8), 59: (-18, 44.5, -3),
    # inner lips: corner, upper lip; lower lip from the middle
    60: (-22.5, 38, 2.5), 61: (-9, 36.5, -7.5), 62: (0, 37, -9), 66: (0, 39.5, -8.5),
    67: (-9, 39, -7),
}

# Displacements at full strength
_DEFORMATIONS = {
    "jaw open": {
        2: (0.5, 1, 0.5), 3: (2, 4, 2.5), 4: (3.5, 10, 7), 5: (4, 16, 11.5),
        6: (3.5, 21, 15), 7: (2, 24, 17), 8: (0, 25, 18), 48: (4.5, 8, 3),
        49: (2, 1.5, 1), 50: (0.5, -0.5, 0), 51: (0, -0.5, 0), 57: (0, 22, 13),
        58: (1, 21, 12.5), 59: (3, 16, 9), 60: (4, 8.5, 3.5), 61: (1, 0, 0.5),
        66: (0, 22.5, 13), 67: (1, 21, 12),
    },
    "smile": {
        3: (-0.5, -0.5, 0), 4: (-2, -1, -0.5), 5: (-2, -1, -0.5), 31: (-2.5, -1, 1),
        32: (-1, -0.5, 0.5), 40: (0, -1, -0.5), 41: (0, -1.5, -0.5), 48: (-10, -11, 8),
        49: (-6, -5, 5), 50: (-2, -0.5, 3), 51: (0, 1, 2.5), 57: (0, 0, 2.5),
        58: (-2.5, -1, 3), 59: (-6.5, -5.5, 5.5), 60: (-9, -10, 7.5),
        61: (-3, -1, 3.5), 62: (0, 1, 2.5), 66: (0, 1, 2.5), 67: (-3, 0, 3.5),
    },
    "brow raise": {
        17: (-2.5, -7, 3.5), 18: (-1.5, -10.5, 4.5), 19: (0, -12.5, 4),
        20: (1, -12, 2), 21: (1.5, -10.5, 0.5), 27: (0, -2, 0.5), 37: (0, -1.5, 0.5),
        38: (0, -1.5, 0.5),
    },
    "blink": {
        17: (0, 0.5, 0), 18: (0, 1, -0.5), 19: (0, 1, -0.5), 36: (-0.5, 1, 0),
        37: (-0.5, 8.5, -2), 38: (0.5, 8.5, -2), 39: (1.5, 0.5, -0.5),
        40: (1.5, -1, -1), 41: (1, -1, -1),
    },
    "lip pucker": {
        5: (1, 0, 0.5), 6: (1, -1, 0.5), 48: (12, 0.5, -7), 49: (7, -1, -7.5),
        50: (2.5, -1.5, -7), 51: (0, -1.5, -6.5), 57: (0, 1.5, -7),
        58: (3.5, 1.5, -7.5), 59: (8, 1, -8), 60: (10.5, 0.5, -7.5), 61: (4, 0, -7.5),
        62: (0, 0, -7), 66: (0, 0, -7), 67: (4, 0, -7.5),
    },
    "brow lower": {
        17: (0.5, 1, -0.5), 18: (2, 3, -1), 19: (3.5, 5.5, -2), 20: (5, 8, -2.5),
        21: (5.5, 9.5, -3), 27: (0, 1.5, -1), 37: (0.5, 1, 0), 38: (1, 2, -0.5),
        39: (0.5, 0.5, 0),
    },
    "nose wrinkle": {
        20: (0.5, 1.5, -0.5), 21: (1, 3, -1), 29: (0, -1.5, 0.5), 30: (0, -4, 1.5),
        31: (-3.5, -6.5, 1.5), 32: (-2, -6, 2), 33: (0, -5, 2), 40: (0, -1.5, -0.5),
        41: (0, -1, -0.5), 49: (-1.5, -4, 1), 50: (-1, -6, 1), 51: (0, -5.5, 1),
        61: (-0.5, -4, 1), 62: (0, -4, 1),
    },
    "face width": {
        0: (-7, 0, 0), 1: (-8, 0, 0), 2: (-9, 0, -0.5), 3: (-10, 0.5, -1),
        4: (-10.5, 1, -2), 5: (-9.5, 0.5, -2), 6: (-7, -1.5, -1), 7: (-3.5, -4, 1),
        8: (0, -5, 1.5),
    },
}
# fmt: on

COMPONENT_NAMES = tuple(_DEFORMATIONS)
# As often negative as positive; the others are expressions.
SIGNED_COMPONENTS = ("face width",)


def mirror_points() -> NDArray[np.intp]:
    """Return the point that mirrors each of the 68 points, in iBUG-68 order."""
    face = get_skeleton("ibug-68")
    mirror = np.arange(N_POINTS)
    mirror[[*face.left, *face.right]] = [*face.right, *face.left]
    return mirror


def neutral_shape() -> NDArray[np.float64]:
    """Return the face at rest, shape (68, 3), in millimetres."""
    return _complete(_NEUTRAL)


def deformations(n_components: int) -> NDArray[np.float64]:
    """Return the first deformations at full strength, (n_components, 68, 3), mm."""
    shapes = [_complete(_DEFORMATIONS[name]) for name in COMPONENT_NAMES[:n_components]]
    return np.reshape(shapes, (n_components, N_POINTS, 3))


def _complete(rows: dict[int, tuple[float, float, float]]) -> NDArray[np.float64]:
    """Add the mirrored half; points that are not listed are zero."""
    index, values = np.array(list(rows)), np.array(list(rows.values()))
    shape = np.zeros((N_POINTS, 3))
    shape[mirror_points()[index]] = values * (-1.0, 1.0, 1.0)
    shape[index] = values
    return shape
