"""Random cameras, and changes of the axes of space."""

import numpy as np
from scipy.spatial.transform import Rotation


def rotations(rng, n_frames, spread=0.6):
    return Rotation.from_rotvec(spread * rng.standard_normal((n_frames, 3))).as_matrix()


def affinity(rng, *stretch):
    """A stretch, between 1/2 and 2 if not given, with any axes and handedness."""
    left, right = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in "ab")
    return left @ np.diag(stretch or [0.5, 1.0, 2.0]) @ right


def weak_perspective(rng, n_frames=30):
    scales = rng.uniform(1, 5, (n_frames, 1, 1))
    return scales * rotations(rng, n_frames)[:, :2]


def lorentz_cameras(rng, n_frames=30):
    """Rows that are orthonormal in the metric diag(1, 1, -1), which is indefinite."""
    angle = rng.uniform(0, 2 * np.pi, n_frames)
    boost = 0.5 * rng.standard_normal(n_frames)
    turn = Rotation.from_euler("z", angle[:, None]).as_matrix()
    squeeze = np.zeros((n_frames, 3, 3))
    squeeze[:, 0, 0] = squeeze[:, 2, 2] = np.cosh(boost)
    squeeze[:, 0, 2] = squeeze[:, 2, 0] = np.sinh(boost)
    squeeze[:, 1, 1] = 1
    return (squeeze @ turn)[:, :2]
