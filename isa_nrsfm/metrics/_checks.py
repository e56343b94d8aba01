"""Check and normalise the arrays that the measures take."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._linalg.rounding import OF_STEPS
from isa_nrsfm._tables.sources import unmasked


def as_finite(name: str, array: ArrayLike) -> NDArray[np.float64]:
    """Return an array of floats; refuse NaN and infinity."""
    values = np.asarray(unmasked(array), dtype=np.float64)
    if not np.isfinite(values).all():
        n_bad = int(np.sum(~np.isfinite(values)))
        raise ValueError(f"{name} must be finite; {n_bad} entries are NaN or infinite")
    return values


def as_shapes(name: str, array: ArrayLike) -> NDArray[np.float64]:
    """Return shapes (n, n_points, 3); refuse anything else."""
    shapes = as_finite(name, array)
    if shapes.ndim != 3 or shapes.shape[2] != 3 or not shapes.size:
        raise ValueError(
            f"{name} must be of the shape (n, n_points, 3); got {shapes.shape}"
        )
    return shapes


def as_mean_shape(name: str, array: ArrayLike, basis: NDArray) -> NDArray[np.float64]:
    """Return a centred mean shape with the points of the basis."""
    shape = as_finite(name, array)
    if shape.shape != basis.shape[1:]:
        raise ValueError(
            f"{name} must be of the shape {basis.shape[1:]} of the basis shapes; got "
            f"{shape.shape}"
        )
    shape = unit_shapes(shape[None])[0]
    if not shape.any():
        raise ValueError(f"all points of {name} are equal")
    return shape


def check_same_shape(name_a: str, a: NDArray, name_b: str, b: NDArray) -> None:
    """Refuse arrays of different shapes."""
    if a.shape != b.shape:
        raise ValueError(
            f"{name_a} and {name_b} must be of the same shape; got {a.shape} and "
            f"{b.shape}"
        )


def as_pair(
    S: ArrayLike, X: ArrayLike, centre: Callable[[NDArray], NDArray]
) -> tuple[NDArray, NDArray]:
    """Return true shapes, none of them flat, and estimated shapes, both centred."""
    truth, shapes = as_shapes("S", S), as_shapes("X", X)
    check_same_shape("S", truth, "X", shapes)
    truth = centre(truth)
    flat = np.flatnonzero(~truth.any(axis=(1, 2)))
    if len(flat):
        raise ValueError(
            f"frames of S whose points are all in one place: {len(flat)} of "
            f"{len(truth)} (first: {flat[0]}). Errors cannot be related to their size. "
            "Remove these frames from S and X"
        )
    return truth, centre(shapes)


def unit_shapes(shapes: NDArray) -> NDArray[np.float64]:
    """Return shapes centred over the points and of unit norm; zero if all are equal."""
    # Shapes of unit size first: squares of very large or small numbers overflow.
    size = np.abs(shapes).max(axis=(1, 2), keepdims=True, initial=0.0)
    shapes = np.divide(shapes, size, out=np.zeros_like(shapes), where=size > 0)
    return normalise(shapes - shapes.mean(axis=1, keepdims=True), OF_STEPS)


def normalise(shapes: NDArray, smallest: float) -> NDArray[np.float64]:
    """Return shapes of unit norm, and zero for those with a norm up to the smallest."""
    norms = np.linalg.norm(shapes, axis=(1, 2), keepdims=True)
    return np.divide(shapes, norms, out=np.zeros_like(shapes), where=norms > smallest)
