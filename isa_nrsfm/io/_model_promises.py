"""Whether the parts of a model file are those of one fit, by what the docs promise.

Arrays of the same shape may have changed places, and numbers may have changed. What
`AffineNRSfM` says of its attributes ties most of them to each other.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.models import PosteriorFrames, RigidFrames

# The largest difference of what should be equal, relative to its size: models of tables
# in single precision have seven digits, of which sums over the frames lose some.
TOLERANCE = 1e-3


def check_promises(
    found: dict[str, Any],
    frames: RigidFrames | PosteriorFrames,
    sizes: NDArray | None,
) -> None:
    """
    Refuse attributes that do not belong together.

    Parameters
    ----------
    found : dict
        The attributes by name, of the right types and shapes; None for those that the
        model does not have.
    frames : RigidFrames or PosteriorFrames
        The model of a frame.
    sizes : ndarray of shape (n_frames,) or None
        Sizes of the frames, where they are kept.

    Raises
    ------
    ValueError
        If a promise is broken; it is named.
    """
    _check_shapes(found["mean_shape_"], found["basis_"], frames)
    values = found["singular_values_"]
    _require(
        bool((values >= 0).all() and (np.diff(values) <= 0).all()),
        "singular_values_ should decrease and not be negative",
    )
    share = found["energy_share_"]
    _require(
        bool((share >= 0).all()) and _close(share.sum(), 1.0 if share.any() else 0.0),
        "energy_share_ should be shares with the sum one",
    )
    history = found["objective_history_"]
    if history is not None:
        _require(
            len(history) == found["n_iter_"] + 1,
            "objective_history_ should have n_iter_ + 1 numbers",
        )
    if sizes is not None:
        _check_frames(found, sizes)


def _check_shapes(
    mean_shape: NDArray, basis: NDArray, frames: RigidFrames | PosteriorFrames
) -> None:
    """Refuse shapes that are not those of the model of a frame, in the gauge."""
    shown = np.concatenate([mean_shape[None], basis])
    if isinstance(frames, RigidFrames):
        own = np.concatenate([frames.mean_shape[None], frames.basis])
    else:
        # Coefficients change by the mixing, shapes by its inverse transpose.
        own = (frames.gauge.space @ frames.shapes).transpose(0, 2, 1)
        shown = np.tensordot(frames.gauge.mixing.T, shown, 1)
    _require(
        _close(shown, own),
        "mean_shape_ and basis_ should be the shapes of frames, in the gauge",
    )


def _check_frames(found: dict[str, Any], sizes: NDArray) -> None:
    """Refuse cameras and coefficients that are not those of the same frames."""
    fitted = np.isfinite(sizes)
    _require(bool((sizes[fitted] > 0).all()), "sizes of frames should be above zero")
    for name in ("motion_", "translation_", "alpha_", "alpha_std_"):
        if found[name] is not None:
            known = np.isfinite(found[name].reshape(len(sizes), -1))
            _require(
                bool((known == fitted[:, None]).all()),
                f"{name} should have numbers for the frames that have a size",
            )
    if found["alpha_std_"] is not None:
        # The joint refinement: coefficients have mean zero and unit variance, but for
        # basis shapes of zeros.
        alpha = found["alpha_"][fitted].astype(np.float64)
        moving = found["basis_"].any(axis=(1, 2))
        _require(
            _close(alpha.mean(axis=0), 0.0) and _close(np.mean(alpha**2, 0), moving),
            "alpha_ should have mean zero and unit variance over the frames",
        )
        _require(
            bool((found["alpha_std_"][fitted] >= 0).all()),
            "alpha_std_ should not be negative",
        )
    if found["scales_"] is not None:
        rows = found["rotations_"][fitted]
        _require(
            _close(rows @ rows.swapaxes(1, 2), np.eye(3)),
            "rotations_ should be orthonormal",
        )
        cameras = found["scales_"][fitted, None, None] * rows[:, :2]
        _require(
            _close(cameras, found["motion_"][fitted]),
            "motion_ should be the scales_ times two rows of the rotations_",
        )


def _close(found: Any, expected: Any) -> bool:
    """Tell whether numbers are equal, up to a share of the largest or of one."""
    size = max(float(np.abs(expected).max(initial=0.0)), 0.0)
    difference = float(np.abs(np.subtract(found, expected)).max(initial=0.0))
    return bool(difference <= TOLERANCE * (size or 1.0))


def _require(promise: bool, expected: str) -> None:
    """Raise if a promise is broken."""
    if not promise:
        raise ValueError(f"{expected}; they do not belong together")
