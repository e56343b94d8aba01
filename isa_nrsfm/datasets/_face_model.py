"""Define a symmetric 68-point face and its expressions.

Millimetres. The origin lies between the nose tip and the ears' plane, x points to the
right in the image, y down and z away from the camera: the nose tip has the smallest
z. Only the half on the left of the image (the subject's right) and the middle are
written down, at the indices of the iBUG-68 scheme; the other half is the mirror image.
"""

import numpy as np
from numpy.typing import NDArray

N_POINTS = 68

# (point, x, y, z)
_NEUTRAL = (
    # jaw, from the ear to the chin
    (0, -72.0, -30.0, 71.0),
    (1, -71.5, -12.0, 69.0),
    (2, -69.5, 6.0, 65.0),
    (3, -66.0, 24.0, 58.0),
    (4, -59.0, 41.0, 47.0),
    (5, -48.0, 56.0, 32.0),
    (6, -34.0, 68.0, 15.0),
    (7, -17.5, 76.0, 3.0),
    (8, 0.0, 79.0, -2.0),
    # brow, from its outer end to the inner end
    (17, -58.0, -46.0, 18.0),
    (18, -50.0, -53.5, 7.0),
    (19, -39.0, -56.5, -1.0),
    (20, -27.0, -55.0, -5.5),
    (21, -15.0, -50.5, -7.5),
    # bridge and tip of the nose
    (27, 0.0, -33.0, -5.0),
    (28, 0.0, -21.5, -11.0),
    (29, 0.0, -10.0, -17.5),
    (30, 0.0, 1.0, -23.0),
    # nostrils
    (31, -14.5, 10.0, -5.0),
    (32, -7.5, 12.5, -9.5),
    (33, 0.0, 14.0, -12.0),
    # eye: outer corner, upper lid, inner corner, lower lid
    (36, -46.0, -33.0, 11.0),
    (37, -38.5, -38.0, 4.5),
    (38, -27.5, -38.0, 3.0),
    (39, -19.0, -31.5, 6.0),
    (40, -27.5, -28.5, 4.5),
    (41, -38.5, -28.5, 6.0),
    # outer lips: corner, upper lip; lower lip from the middle
    (48, -26.0, 38.0, 4.0),
    (49, -16.5, 32.5, -5.0),
    (50, -6.5, 29.0, -10.5),
    (51, 0.0, 30.5, -11.5),
    (57, 0.0, 49.0, -9.0),
    (58, -8.5, 48.0, -8.0),
    (59, -18.0, 44.5, -3.0),
    # inner lips: corner, upper lip; lower lip from the middle
    (60, -22.5, 38.0, 2.5),
    (61, -9.0, 36.5, -7.5),
    (62, 0.0, 37.0, -9.0),
    (66, 0.0, 39.5, -8.5),
    (67, -9.0, 39.0, -7.0),
)

# (name, (point, dx, dy, dz) at full strength)
_DEFORMATIONS = (
    (
        "jaw open",
        (
            (2, 0.5, 1.0, 0.5),
            (3, 2.0, 4.0, 2.5),
            (4, 3.5, 10.0, 7.0),
            (5, 4.0, 16.0, 11.5),
            (6, 3.5, 21.0, 15.0),
            (7, 2.0, 24.0, 17.0),
            (8, 0.0, 25.0, 18.0),
            (48, 4.5, 8.0, 3.0),
            (49, 2.0, 1.5, 1.0),
            (50, 0.5, -0.5, 0.0),
            (51, 0.0, -0.5, 0.0),
            (57, 0.0, 22.0, 13.0),
            (58, 1.0, 21.0, 12.5),
            (59, 3.0, 16.0, 9.0),
            (60, 4.0, 8.5, 3.5),
            (61, 1.0, 0.0, 0.5),
            (66, 0.0, 22.5, 13.0),
            (67, 1.0, 21.0, 12.0),
        ),
    ),
    (
        "smile",
        (
            (3, -0.5, -0.5, 0.0),
            (4, -2.0, -1.0, -0.5),
            (5, -2.0, -1.0, -0.5),
            (31, -2.5, -1.0, 1.0),
            (32, -1.0, -0.5, 0.5),
            (40, 0.0, -1.0, -0.5),
            (41, 0.0, -1.5, -0.5),
            (48, -10.0, -11.0, 8.0),
            (49, -6.0, -5.0, 5.0),
            (50, -2.0, -0.5, 3.0),
            (51, 0.0, 1.0, 2.5),
            (57, 0.0, 0.0, 2.5),
            (58, -2.5, -1.0, 3.0),
            (59, -6.5, -5.5, 5.5),
            (60, -9.0, -10.0, 7.5),
            (61, -3.0, -1.0, 3.5),
            (62, 0.0, 1.0, 2.5),
            (66, 0.0, 1.0, 2.5),
            (67, -3.0, 0.0, 3.5),
        ),
    ),
    (
        "brow raise",
        (
            (17, -2.5, -7.0, 3.5),
            (18, -1.5, -10.5, 4.5),
            (19, 0.0, -12.5, 4.0),
            (20, 1.0, -12.0, 2.0),
            (21, 1.5, -10.5, 0.5),
            (27, 0.0, -2.0, 0.5),
            (37, 0.0, -1.5, 0.5),
            (38, 0.0, -1.5, 0.5),
        ),
    ),
    (
        "blink",
        (
            (17, 0.0, 0.5, 0.0),
            (18, 0.0, 1.0, -0.5),
            (19, 0.0, 1.0, -0.5),
            (36, -0.5, 1.0, 0.0),
            (37, -0.5, 8.5, -2.0),
            (38, 0.5, 8.5, -2.0),
            (39, 1.5, 0.5, -0.5),
            (40, 1.5, -1.0, -1.0),
            (41, 1.0, -1.0, -1.0),
        ),
    ),
    (
        "lip pucker",
        (
            (5, 1.0, 0.0, 0.5),
            (6, 1.0, -1.0, 0.5),
            (48, 12.0, 0.5, -7.0),
            (49, 7.0, -1.0, -7.5),
            (50, 2.5, -1.5, -7.0),
            (51, 0.0, -1.5, -6.5),
            (57, 0.0, 1.5, -7.0),
            (58, 3.5, 1.5, -7.5),
            (59, 8.0, 1.0, -8.0),
            (60, 10.5, 0.5, -7.5),
            (61, 4.0, 0.0, -7.5),
            (62, 0.0, 0.0, -7.0),
            (66, 0.0, 0.0, -7.0),
            (67, 4.0, 0.0, -7.5),
        ),
    ),
    (
        "brow lower",
        (
            (17, 0.5, 1.0, -0.5),
            (18, 2.0, 3.0, -1.0),
            (19, 3.5, 5.5, -2.0),
            (20, 5.0, 8.0, -2.5),
            (21, 5.5, 9.5, -3.0),
            (27, 0.0, 1.5, -1.0),
            (37, 0.5, 1.0, 0.0),
            (38, 1.0, 2.0, -0.5),
            (39, 0.5, 0.5, 0.0),
        ),
    ),
    (
        "nose wrinkle",
        (
            (20, 0.5, 1.5, -0.5),
            (21, 1.0, 3.0, -1.0),
            (29, 0.0, -1.5, 0.5),
            (30, 0.0, -4.0, 1.5),
            (31, -3.5, -6.5, 1.5),
            (32, -2.0, -6.0, 2.0),
            (33, 0.0, -5.0, 2.0),
            (40, 0.0, -1.5, -0.5),
            (41, 0.0, -1.0, -0.5),
            (49, -1.5, -4.0, 1.0),
            (50, -1.0, -6.0, 1.0),
            (51, 0.0, -5.5, 1.0),
            (61, -0.5, -4.0, 1.0),
            (62, 0.0, -4.0, 1.0),
        ),
    ),
    (
        "face width",
        (
            (0, -7.0, 0.0, 0.0),
            (1, -8.0, 0.0, 0.0),
            (2, -9.0, 0.0, -0.5),
            (3, -10.0, 0.5, -1.0),
            (4, -10.5, 1.0, -2.0),
            (5, -9.5, 0.5, -2.0),
            (6, -7.0, -1.5, -1.0),
            (7, -3.5, -4.0, 1.0),
            (8, 0.0, -5.0, 1.5),
        ),
    ),
)

COMPONENT_NAMES = tuple(name for name, _ in _DEFORMATIONS)
# Those that are as often negative as positive; the others are expressions.
SIGNED_COMPONENTS = ("face width",)


def mirror_points() -> NDArray[np.intp]:
    """Return the point that mirrors each of the 68 points, in iBUG-68 order."""
    return np.r_[
        16:-1:-1,  # jaw
        26:16:-1,  # brows
        27:31,  # bridge of the nose
        35:30:-1,  # nostrils
        45:41:-1, 47, 46,  # right eye
        39:35:-1, 41, 40,  # left eye
        54:47:-1, 59:54:-1,  # outer lips
        64:59:-1, 67:64:-1,  # inner lips
    ]  # fmt: skip


def neutral_shape() -> NDArray[np.float64]:
    """Return the face at rest, shape (68, 3), in millimetres."""
    return _complete(_NEUTRAL)


def deformations(n_components: int) -> NDArray[np.float64]:
    """Return the first deformations at full strength, (n_components, 68, 3), mm."""
    shapes = [_complete(rows) for _, rows in _DEFORMATIONS[:n_components]]
    return np.reshape(shapes, (n_components, N_POINTS, 3))


def _complete(rows: tuple[tuple[int, float, float, float], ...]) -> NDArray[np.float64]:
    """Fill in the mirrored half; points that are not listed are zero."""
    index = np.array([row[0] for row in rows])
    values = np.array([row[1:] for row in rows])
    shape = np.zeros((N_POINTS, 3))
    shape[mirror_points()[index]] = values * (-1.0, 1.0, 1.0)
    shape[index] = values
    return shape
