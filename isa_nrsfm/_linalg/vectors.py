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
    """
    Return numbers of frames, the last one repeated up to a multiple of `LANES`.

    In arrays with the frame as the last index, the numbers that are found for a frame
    then do not depend on how many frames there are, to the last bit. Frames that come
    several times stay equal, and may be written to the same place.

    Parameters
    ----------
    frames : ndarray of int, shape (n_frames,)
        Numbers of frames.

    Returns
    -------
    ndarray of int, shape (n_filled,)
        The numbers, none for none.
    """
    return np.concatenate([frames, np.repeat(frames[-1:], -len(frames) % LANES)])


def of_frames(values: NDArray, frames: NDArray | slice) -> NDArray:
    """
    Return what belongs to some of the frames.

    Parameters
    ----------
    values : ndarray of shape (..., n_frames)
        Numbers of all frames.
    frames : ndarray of int, shape (n_taken,), or slice
        The frames.

    Returns
    -------
    ndarray of shape (..., n_taken)
        Their numbers, with the frame as the last axis in memory, too. Sums are rounded
        by that order. Indexing with an array would put the frame first.
    """
    if isinstance(frames, slice):
        return values[..., frames]
    return np.take(values, frames, axis=-1)


def frames_last(motion: NDArray) -> NDArray:
    """
    Return matrices with the frame as the last index.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, a, b)
        A matrix for each frame, such as a camera.

    Returns
    -------
    ndarray of shape (a, b, n_frames)
        The same, with long rows over the frames in memory: `motion` itself where it
        comes from `frames_first`, and a copy otherwise.
    """
    return np.ascontiguousarray(motion.transpose(1, 2, 0))


def frames_first(M: NDArray) -> NDArray:
    """
    Return matrices with the frame as the first index.

    Parameters
    ----------
    M : ndarray of shape (a, b, n_frames)
        A matrix for each frame.

    Returns
    -------
    ndarray of shape (n_frames, a, b)
        A view of them. `frames_last` takes it back without a copy.
    """
    return M.transpose(2, 0, 1)


def orientations(rows: NDArray) -> NDArray:
    """
    Return a sign for each row: that of its third moment.

    The sign does not depend on the order of the entries. Where the third moment
    vanishes the entry of largest magnitude decides, in the order of the entries.

    Parameters
    ----------
    rows : ndarray of shape (n_rows, n_entries)
        Rows, each known up to its sign.

    Returns
    -------
    ndarray of shape (n_rows,)
        1.0 or -1.0.
    """
    largest = np.abs(rows).max(axis=1, keepdims=True)
    scaled = np.divide(rows, largest, out=np.zeros_like(rows), where=largest > 0)
    moment = np.sum(scaled**3, axis=1)
    decisive = np.abs(moment) > 1e-9 * np.sum(np.abs(scaled) ** 3, axis=1)
    extreme = scaled[np.arange(len(rows)), np.abs(scaled).argmax(axis=1)]
    return np.where(np.where(decisive, moment, extreme) < 0, -1.0, 1.0)


def polar(matrices: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return the polar decompositions ``A = P O`` of matrices.

    Parameters
    ----------
    matrices : ndarray of shape (..., m, d)
        Matrices A with ``m <= d``.

    Returns
    -------
    rows : ndarray of shape (..., m, d)
        O, the matrices with orthonormal rows that are nearest to A.
    values : ndarray of shape (..., m)
        Singular values of A, the eigenvalues of P.
    axes : ndarray of shape (..., m, m)
        Eigenvectors of P, in the columns.
    """
    U, values, Vt = np.linalg.svd(matrices, full_matrices=False)
    return U @ Vt, values, U
