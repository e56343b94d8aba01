"""The whole distribution of a shape: all its directions, by their evidence.

A shape has 3J - 7 directions of deformation. With calibrated cameras the joint fit has
as many of them as frames and time allow, whatever number of coefficients is reported:
deformation that a fit lacks would distort cameras and depths.

The 3J numbers of each direction have a prior variance v_k, which follows from the table
(automatic relevance determination: MacKay, "Bayesian interpolation", 1992; Bishop,
"Bayesian PCA", 1999). With the posterior covariance ``cov B_k``, the coefficients'
moments held fixed, the iteration is

    g_k = 1 - tr(cov B_k) / (3J v_k),   v_k <- ||B_k||^2 / (3J g_k).

g_k is the share of the 3J numbers of B_k that the table determines rather than the
prior. Directions that fit noise get smaller, and less determined, with each round.
Points deform alike in x, y and z: a prior of the images would let depths deform without
limit, and faces that turn less and deform ten times more in depth would be as likely.

The noise variance s2 follows in the same way. Of the N coordinates ``n = sum_i (2 + p)
+ 3J (1 + sum_k g_k)`` determine positions, the p parameters of each camera, and the
shapes. The objective has ``(N - n) log s2`` in place of ``N log s2``: otherwise s2
vanishes as soon as there are enough directions to explain a frame by them.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._joint.problem import JointFit, JointProblem, JointState, Widths, regular
from isa_nrsfm._joint.starts import camera_moments
from isa_nrsfm._linalg import OF_DISTANCES, frames_first, frames_last, unpacked

# All of these: docs/benchmarks/README.md, "Thresholds".
# Largest number of directions: of small complete tables, and of others, where each
# frame or point has matrices of its own.
MOST_DIRECTIONS, FEW_DIRECTIONS = 60, 24
# Sizes of further directions at first, as a share of that of the mean shape.
FIRST_SIZE = 0.03
# Noise variance of the first fit of all directions, as a share of the mean square: the
# floor of large motion, at which fits from different starts are compared.
FIRST_NOISE = 1e-3
# Floor of the noise variance, for tables without noise
LEAST_NOISE = 1e-5
# Number of frames whose likelihoods tell two explanations of a table apart:
# docs/depth.md, "How it is estimated".
FAR_FRAMES = 4


def n_directions(problem: JointProblem, n_points: int, few: bool) -> int:
    """Return the number of directions of a joint fit.

    At least half of the coordinates have to be left for the noise.
    """
    n_max = FEW_DIRECTIONS if few else MOST_DIRECTIONS
    n_pose = (2 + problem.cameras.n_parameters) * problem.frames.n_frames
    n_shapes = (problem.frames.totals[0] / 2 - n_pose) / (3 * n_points)
    return max(min(3 * n_points - 7, n_max, int(n_shapes) - 1), 1)


def extended(
    problem: JointProblem,
    state: JointState,
    n: int,
    max_iter: int = 40,
    tol: float = 1.0,
) -> JointFit:
    """Return the fit of n directions with the first noise, from a state with less.

    `tol` is a factor of the tolerance.
    """
    n_more = n + 1 - len(state.shapes)
    if n_more > 0:
        _, _, n_points = state.shapes.shape
        more = np.random.RandomState(0).standard_normal((n_more, 3, n_points))
        more = problem.frames.centred(more)
        size = FIRST_SIZE * np.linalg.norm(state.shapes[0])
        more *= size / np.linalg.norm(more, axis=(1, 2))[:, None, None]
        state = state._replace(shapes=np.concatenate([state.shapes, more]))
    free = replace(problem, penalty=0.0, widths=None)
    tol *= problem.settings.tol
    return free.refined(state, least_noise=FIRST_NOISE, max_iter=max_iter, tol=tol)


def whole_distribution(problem: JointProblem, state: JointState) -> JointFit:
    """Return the fit with the variances of its directions and the noise."""
    widths, n_now, tol = None, np.inf, problem.settings.tol
    for _ in range(10):
        state, widths = determined(problem, state, widths)
        part = replace(problem, widths=widths)
        fit = part.refined(state, least_noise=LEAST_NOISE, max_iter=30, tol=tol)
        state = fit.state
        before, n_now = n_now, widths.shares.sum()
        if abs(n_now - before) < 0.02 * n_now + 0.1:
            break
    return fit


def determined(
    problem: JointProblem, state: JointState, widths: Widths | None
) -> tuple[JointState, Widths]:
    """Return a state along its principal directions, and their prior variances."""
    n_numbers = 3 * problem.frames.points(state.shapes).shape[2]
    # Positions of shapes have no images.
    state = state._replace(shapes=problem.frames.centred(state.shapes))
    # Orthogonal basis shapes
    basis = state.shapes[1:]
    energy, axes = np.linalg.eigh(np.tensordot(basis, basis, axes=([1, 2], [1, 2])))
    energy, axes = np.maximum(energy[::-1], 0.0), axes[:, ::-1]
    basis = np.tensordot(axes.T, basis, 1)
    state = state._replace(shapes=np.concatenate([state.shapes[:1], basis]))
    floor = 1e-9 * max(energy.max(), OF_DISTANCES * problem.mean_square) / n_numbers
    variances = np.maximum(energy / n_numbers, floor)
    if widths is not None:  # of the same directions, nearly in the same order
        variances = widths.variances[: len(energy)]
    # Posterior covariance of each point: half the Hessian is curvature / s2.
    ones = np.ones(len(energy))
    part = replace(problem, widths=Widths(variances, ones, ones, n_numbers))
    curvature = part.likelihood(*state).shape_curvature
    covariance = state.noise * np.linalg.inv(regular(curvature))
    # If all weights are one, one matrix is valid for all points.
    total = covariance.sum(axis=0) * (n_numbers / 3 / len(covariance))
    total = total.reshape(len(basis) + 1, 3, len(basis) + 1, 3)
    C, prior = camera_moments(state.motion), variances * n_numbers
    uncertain = np.einsum("kaka->k", total)[1:] / prior
    of_images = np.einsum("ab,kakb->k", 3 * C / np.trace(C), total)[1:] / prior
    shares = np.clip(1.0 - uncertain, 1e-9, 1.0)
    variances = np.maximum(energy / (n_numbers * shares), floor)
    # The large noise of the first round hides directions.
    kept = (shares > 0.02) | (widths is None)
    kept[0] = True
    shapes = state.shapes[np.append(True, kept)]
    widths = Widths(variances[kept], shares[kept], 1.0 - of_images[kept], n_numbers)
    return state._replace(shapes=shapes), widths


def evidence(problem: JointProblem, fit: JointFit) -> float:
    """Return -2 log evidence of a fit for each frame, up to a constant.

    The objective has all coefficients integrated out, but takes cameras and shapes as
    known. Laplace's method integrates them out (MacKay, 1992): with the Hessians C_i of
    the cameras, the covariance V of the lines of sight in the object, and the Hessian A
    of the shapes, for n frames and F with ``(N - 2n) log s2``, ::

        F / n + mean_i log det C_i + log det V + (log det A + 3J sum_k log v_k) / n.

    v_0 is the mean square of the mean shape. So turning has a price, as deforming has.
    det V is that along the two axes of largest spread. Without widths the shapes have
    no prior and do not count.
    """
    part, widths = replace(problem, penalty=0.0, widths=fit.widths), fit.widths
    shapes, motion, noise = fit.state
    terms = part.objective._replace(n_unknowns=2.0 * len(motion))(*fit.state)
    M = frames_last(motion)
    turns = unpacked(problem.cameras.curvature(M, terms.motion_curvature))
    price = np.linalg.slogdet(frames_first(turns) / noise)[1].mean()
    views = full_rotations(motion)[0][:, 2]
    spread = np.linalg.eigvalsh(np.cov(views.T))[1:]
    price += np.log(np.maximum(spread, OF_DISTANCES)).sum()
    if not np.isfinite(price):  # images without extent
        return np.inf
    if widths is not None:
        cost = np.linalg.slogdet(regular(terms.shape_curvature) / noise)[1].mean()
        cost = cost / 3 + np.log(widths.variances).sum()
        cost += np.log(np.sum(shapes[0] ** 2) / widths.n_numbers)
        price += widths.n_numbers * cost / len(motion)
    return float(terms.value / len(motion) + price)


def rival_depths(problem: JointProblem, fits: list[tuple[float, JointFit]]) -> float:
    """Return the mean squared difference of the depths of fits from those of the first.

    Relative to the mean square, each with its probability ``exp(-m (e - e_0))`` by the
    evidence e of m = `FAR_FRAMES` frames, and mirrored if that is nearer.
    """
    best, total = fits[0][0], 0.0
    parts = ((replace(problem, widths=fit.widths), fit.state) for _, fit in fits)
    z, *others = (part.depths(state) for part, state in parts)
    for (value, _), other in zip(fits[1:], others, strict=True):
        probability = np.exp(-FAR_FRAMES * max(value - best, 0.0))
        total += probability * relative_change(z, other)
    return float(total)


def relative_change(z: NDArray, other: NDArray) -> float:
    """Return the relative squared difference of other depths, or of their mirror image.

    That of the nearer ones, over the squared depths z.
    """
    other = other * np.copysign(1.0, np.sum(other * z))
    return float(np.sum((other - z) ** 2) / max(np.sum(z**2), 1e-300))
