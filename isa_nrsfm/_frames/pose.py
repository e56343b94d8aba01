"""What the yaw of calibrated cameras predicts of coefficients."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import full_rotations


def pose_effect(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return the regression (3, K) of coefficients (n, K) on 1, s and s^2.

    Predictions have mean zero over the frames.
    """
    known = np.isfinite(alpha).all(axis=1)
    terms = _terms(motion[known])
    effect = np.linalg.lstsq(terms.T, alpha[known])[0]
    effect[0] -= effect.T @ terms.mean(axis=1)
    return np.asarray(effect)


def pose_part(motion: NDArray, effect: NDArray) -> NDArray:
    """Return the coefficients (n, K) that cameras (n, 2, 3) predict."""
    part = (_terms(motion)[..., None] * effect[:, None]).sum(axis=0)
    return part.astype(motion.dtype, copy=False)


def _terms(motion: NDArray) -> NDArray:
    """Return 1, s and s^2 (3, n) of cameras (n, 2, 3), with s the sine of the yaw.

    It is the part of the line of sight along x: of objects that are seen from above,
    the yaw jumps, and s does not.
    """
    s = full_rotations(motion)[0][:, 2, 0]
    return np.stack([np.ones_like(s), s, s**2])
