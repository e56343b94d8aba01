"""Align and match shapes up to an affinity of space and a scale of each shape.

Shapes are (n, n_points, 3), one point a row; an affinity is a 3x3 matrix that is
multiplied from the right.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from isa_nrsfm._linalg.rounding import OF_STEPS


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


# Places of matched true and estimated basis shapes, and absolute cosines of the pairs.
Matched = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]


def match_basis(truth: NDArray, shapes: NDArray, affinity: NDArray) -> Matched:
    """Match unit shapes, the second ones after an affinity, by squared cosines."""
    n_true = len(truth)
    images = normalise(shapes @ affinity, OF_STEPS * float(np.linalg.norm(affinity)))
    inner = truth.reshape(n_true, -1) @ images.reshape(len(images), -1).T
    cosines = np.minimum(np.abs(inner), 1.0)  # rounding may lead beyond 1
    rows, columns = linear_sum_assignment(cosines**2, maximize=True)
    return rows, columns, cosines[rows, columns]


def match_basis_up_to_affinity(truth: NDArray, shapes: NDArray) -> Matched:
    """Match unit shapes under the best affinity for all of them together."""
    starts = [np.eye(3)]
    starts += [np.linalg.lstsq(x, s)[0] for s in truth for x in shapes]
    best, tried = match_basis(truth, shapes, starts[0]), set()
    for start in starts:
        rows, columns, cosines = match_basis(truth, shapes, start)
        # The next steps depend only on the pairs: stop if they repeat.
        while (pairs := (rows.tobytes(), columns.tobytes())) not in tried:
            tried.add(pairs)
            affinity = best_affinity(truth[rows], shapes[columns])
            rows, columns, cosines = match_basis(truth, shapes, affinity)
            if np.sum(cosines**2) > np.sum(best[2] ** 2):
                best = rows, columns, cosines
    return best


def without_mean_shape(shapes: NDArray, mean_shape: NDArray) -> NDArray:
    """Remove multiples of the mean shape from unit shapes; return unit shapes.

    The rest is orthogonal to the mean shape in the coordinates in which that is white,
    so that the multiples do not change under an affinity of both.
    """
    dual = np.linalg.pinv(mean_shape).T
    multiples = np.sum(shapes * dual, axis=(1, 2)) / np.sum(mean_shape * dual)
    return normalise(shapes - multiples[:, None, None] * mean_shape, OF_STEPS)


def best_affinity(truth: NDArray, shapes: NDArray) -> NDArray[np.float64]:
    """Return the 3x3 affinity with the largest sum of squared cosines to the truth.

    All shapes are centred and of unit norm, or zero. With the best factor of each pair
    ``sum ||truth - factor * shapes @ affinity||^2`` is the number of pairs less this
    sum, so that the affinity minimises it.
    """
    # The mean scatter becomes the unit matrix; directions without scatter drop out.
    values, axes = np.linalg.eigh(np.mean(shapes.transpose(0, 2, 1) @ shapes, axis=0))
    kept = values > OF_STEPS * values[-1]
    if not kept.any():
        return np.zeros((3, 3))
    whitener = axes[:, kept] / np.sqrt(values[kept])
    white = shapes @ whitener
    cross = (white.transpose(0, 2, 1) @ truth).reshape(len(truth), -1)
    scatter = white.transpose(0, 2, 1) @ white

    # Equal scatters would make the first of these the solution.
    starts = [cross.sum(axis=0), *np.linalg.svd(cross, full_matrices=False)[2][:3]]
    found = [_climb(start, cross, scatter) for start in starts if start.any()]
    if not found:
        return np.zeros((3, 3))
    _, affinity = max(found, key=lambda item: item[0])
    return whitener @ affinity.reshape(-1, 3)


def _climb(
    start: NDArray, cross: NDArray, scatter: NDArray
) -> tuple[float, NDArray[np.float64]]:
    """Maximise ``sum <a, cross_i>^2 / <a, scatter_i a>`` over unit vectors a."""
    a = start / np.linalg.norm(start)
    value, gradient, hessian = _squared_cosines(a, cross, scatter)
    for _ in range(100):
        # The function does not change along a: exclude this direction.
        tangent = np.eye(len(a)) - np.outer(a, a)
        values, axes = np.linalg.eigh(tangent @ hessian @ tangent - np.outer(a, a))
        # Ascend even if the curvature has the wrong sign. Bound its size from below.
        curvature = np.maximum(np.abs(values), 1e-8 * np.abs(values).max())
        step = axes @ ((axes.T @ gradient) / curvature)
        gain = float(gradient @ step)
        if gain <= 1e-28 * len(cross):
            break
        # If the gain is smaller than the rounding of the value, accept any step.
        needed = 0.1 * gain if gain > 1e-10 * len(cross) else -np.inf
        for fraction in 0.5 ** np.arange(30):
            moved = a + fraction * step
            moved /= np.linalg.norm(moved)
            new = _squared_cosines(moved, cross, scatter)
            if new[0] >= value + fraction * needed:
                break
        else:
            break
        a, (value, gradient, hessian) = moved, new
    return value, a


def _squared_cosines(
    a: NDArray, cross: NDArray, scatter: NDArray
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Return the sum that `_climb` maximises, its gradient and its Hessian matrix."""
    half = (scatter @ a.reshape(-1, 3)).reshape(cross.shape)  # half the slope of q
    r, q = cross @ a, half @ a
    t = quotient(r, q)  # the best factor of each pair
    u, w = quotient(t, q), quotient(np.ones_like(q), q)
    gradient = 2 * (t @ cross - t**2 @ half)
    mixed = (cross * u[:, None]).T @ half
    hessian = 2 * (cross * w[:, None]).T @ cross - 4 * (mixed + mixed.T)
    hessian += 8 * (half * (t * u)[:, None]).T @ half
    hessian -= 2 * np.kron(np.tensordot(t**2, scatter, 1), np.eye(3))
    return float(r @ t), gradient, hessian


def quotient(numerator: NDArray, denominator: NDArray) -> NDArray[np.float64]:
    """Divide; zero where the denominator is zero up to rounding."""
    usable = denominator > OF_STEPS**2
    return np.divide(
        numerator, denominator, out=np.zeros_like(denominator), where=usable
    )
