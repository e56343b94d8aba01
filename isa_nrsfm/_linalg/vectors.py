"""Energies and signs of rows of numbers, and the axes of one matrix for each frame."""

import numpy as np
from numpy.typing import NDArray


def energies(rows: NDArray) -> NDArray[np.float64]:
    """Return the sums of the squares of arrays (n_frames, ...), in double precision."""
    flat = rows.reshape(len(rows), -1).astype(np.float64, copy=False)
    return np.vecdot(flat, flat)


# Where the number of frames is no multiple of this, sums are rounded in another way for
# the last of them: by NumPy's einsum for a single frame, by BLAS at the edges of tiles.
LANES = 16


def in_lanes(frames: NDArray) -> NDArray:
    """Return numbers of frames (n,), the last one repeated up to a multiple of `LANES`.

    With the frame as the last index, results of a frame then do not depend on the
    number of frames, to the last bit. Repeated frames may be written to the same place.
    """
    return np.concatenate([frames, np.repeat(frames[-1:], -len(frames) % LANES)])


def of_frames(values: NDArray, frames: NDArray | slice) -> NDArray:
    """Return values (..., n_taken) of frames, which stay the last axis in memory."""
    if isinstance(frames, slice):
        return values[..., frames]
    return np.take(values, frames, axis=-1)


def frames_last(motion: NDArray) -> NDArray:
    """Return matrices (n, a, b) as (a, b, n), with long rows over the frames."""
    return np.ascontiguousarray(motion.transpose(1, 2, 0))


def frames_first(M: NDArray) -> NDArray:
    """Return a view (n, a, b) of matrices (a, b, n)."""
    return M.transpose(2, 0, 1)


def orientations(rows: NDArray) -> NDArray:
    """Return the sign of the third moment, or largest entry, of rows (n, m)."""
    largest = np.abs(rows).max(axis=1, keepdims=True)
    scaled = np.divide(rows, largest, out=np.zeros_like(rows), where=largest > 0)
    moment = np.sum(scaled**3, axis=1)
    decisive = np.abs(moment) > 1e-9 * np.sum(np.abs(scaled) ** 3, axis=1)
    extreme = scaled[np.arange(len(rows)), np.abs(scaled).argmax(axis=1)]
    return np.where(np.where(decisive, moment, extreme) < 0, -1.0, 1.0)


def polar(matrices: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return polar decompositions ``A = P O`` of matrices (..., m, d), ``m <= d``.

    O (..., m, d) are the nearest orthonormal rows. Also returns the eigenvalues (...,
    m) of P, the singular values of A, and its eigenvectors (..., m, m) in columns.
    """
    U, values, Vt = np.linalg.svd(matrices, full_matrices=False)
    return U @ Vt, values, U
