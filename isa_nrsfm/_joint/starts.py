"""Starts of the joint fit: calibrated cameras, and shapes that fit them.

The cameras of a deforming object are linear combinations of few columns of the motion
factor of its table (Xiao, Chai, Kanade 2006). Their cost always falls with more
columns. The rigid cameras are tried first, then mixtures of more and more columns,
until the objective of the fit rises.
"""

from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera_models import (
    AffineCameras,
    CameraModel,
    full_rotations,
    nearest_calibrated,
    rigid_cameras,
)
from isa_nrsfm._joint.prior import STEP, ShapePrior
from isa_nrsfm._joint.problem import FactorisedTable, JointFit, JointProblem, JointState
from isa_nrsfm._linalg import OF_PRODUCTS, frames_last
from isa_nrsfm._tables import spread
from isa_nrsfm.calibration._metric_upgrade import best_metric
from isa_nrsfm.calibration._orthonormal_cameras import (
    orthonormal_mixture,
    principal_columns,
)
from isa_nrsfm.isa._pipeline import rigid_energy

# Largest number of steps of a start with fixed cameras.
FIXED_STEPS = 6


def calibrated_start(
    motion: NDArray, shapes: NDArray, scaled: bool = True
) -> tuple[NDArray, NDArray]:
    """Return calibrated cameras near affine ones (I, 2, 3), and their shapes.

    After a metric upgrade, takes the nearest calibrated ones. Unless `scaled`, all
    cameras have scale one.
    """
    Q = best_metric(motion)
    rows, sizes = nearest_calibrated(motion @ Q)
    shapes = np.linalg.solve(Q, shapes)
    if scaled:
        return sizes[:, None, None] * rows, shapes
    return rows, sizes.mean() * shapes


def mixed_cameras(
    rows: NDArray, scales: NDArray | None, chosen: NDArray, widths: tuple[int, ...]
) -> Iterator[NDArray]:
    """Yield calibrated cameras (I, 2, 3), mixtures of more and more columns.

    Rows (I, 2, J) are complete and centred. `scales` (I,) divide the frames before the
    mixture; None for cameras of scale one. The mixtures come from `chosen` frames.
    """
    unit = rows
    if scales is not None:  # zero for frames without points that count
        unit = rows / np.where(scales > 0, scales, 1.0)[:, None, None]
    P = principal_columns(unit.reshape(2 * len(unit), -1)).reshape(len(unit), 2, -1)
    rank = P.shape[2]
    if rank < 3:
        return
    sample = P[chosen].reshape(2 * len(chosen), -1)
    # Each width starts from the mixture of the previous width.
    mixing, _ = orthonormal_mixture(sample[:, :3], np.eye(3), max_iter=20)
    for n in sorted({min(n, rank) for n in widths if n < rank + 3}):
        mixing, _ = orthonormal_mixture(sample[:, :n], mixing, max_iter=20)
        cameras, sizes = nearest_calibrated(P[..., :n] @ mixing)
        yield cameras if scales is None else (scales * sizes)[:, None, None] * cameras


def lifted_shapes(rows: NDArray, motion: NDArray, n_components: int) -> NDArray:
    """Return shapes (K + 1, 3, J) that fit calibrated cameras and rows (I, 2, J).

    The mean shape solves the least squares problem ``(sum_i M_i^T M_i) B_0 = sum_i
    M_i^T W_i``. `extended_shapes` computes the basis shapes.
    """
    gram = np.einsum("ira,irb->ab", motion, motion)
    mean_shape = np.linalg.lstsq(gram, np.einsum("ira,irj->aj", motion, rows))[0][None]
    none = np.zeros((len(rows), 0))
    return extended_shapes(rows, mean_shape, motion, none, n_components)


def extended_shapes(
    rows: NDArray, shapes: NDArray, motion: NDArray, alpha: NDArray, n_more: int
) -> NDArray:
    """Return fitted shapes (n, 3, J) and n_more basis shapes along the residuals.

    The first principal components of the residuals ``M_i^+ (W_i - M_i S_i)`` of rows
    (I, 2, J), lifted to space parallel to the image plane, as long as the standard
    deviation of their coefficients. Zeros if there are fewer.
    """
    residual = rows - motion @ (shapes[0] + np.tensordot(alpha, shapes[1:], 1))
    lifted = (np.linalg.pinv(motion) @ np.nan_to_num(residual)).reshape(len(rows), -1)
    # Principal components, from the smaller Gram matrix
    tall = len(lifted) > lifted.shape[1]
    square, axes = np.linalg.eigh(lifted.T @ lifted if tall else lifted @ lifted.T)
    values = np.sqrt(np.maximum(square[::-1][:n_more], 0.0))[:, None]
    axes = axes[:, ::-1][:, :n_more].T
    components = values * axes if tall else axes @ lifted
    more = np.zeros((n_more, *shapes.shape[1:]))
    more[: len(components)] = components.reshape(-1, *shapes.shape[1:])
    return np.concatenate([shapes, more / np.sqrt(len(rows))])


def steadied(motion: NDArray) -> NDArray:
    """Return calibrated cameras (I, 2, 3) without the turning about the main axis.

    The axis is the one that is most nearly perpendicular to all lines of sight. These
    are turned about it into one plane that contains it.
    """
    views = full_rotations(motion)[0][:, 2]
    frame = np.linalg.eigh(views.T @ views)[1][:, ::-1]  # the axis is the last column
    frame[:, 2] *= np.linalg.det(frame)
    across = views @ frame
    angle = np.arctan2(across[:, 1], across[:, 0])
    return motion @ Rotation.from_rotvec(np.outer(angle, frame[:, 2])).as_matrix()


def reversed_groups(
    problem: JointProblem, rows: NDArray, motion: NDArray, alpha: NDArray, n_groups: int
) -> NDArray:
    """Return cameras (I, 2, 3) with groups of similar frames turned back in depth.

    If all frames of a group are reversed, the shapes contain their mirror images. So
    each group, of at most half of the frames, is compared under shapes that fit the
    others. alpha (I, K): coefficients, for the groups (Ward, "Hierarchical grouping to
    optimize an objective function", 1963).
    """
    group = fcluster(linkage(alpha, "ward"), n_groups, "maxclust")
    for number in range(1, group.max() + 1):
        members, other_frames = group == number, np.flatnonzero(group != number)
        if 2 * members.sum() > len(members):
            continue
        part = problem.part(other_frames, problem.settings.tol)
        shapes = lifted_shapes(rows[other_frames], motion[other_frames], alpha.shape[1])
        state = held_fit(part, rows[other_frames], motion[other_frames], shapes).state
        state, _ = problem.reversed_back(state._replace(motion=motion))
        motion = np.where(members[:, None, None], state.motion, motion)
    return motion


def across_plane(mean_shape: NDArray) -> NDArray:
    """Return the projection (3, 3) on the axis of least extent of a shape (3, J)."""
    normal = np.linalg.eigh(mean_shape @ mean_shape.T)[1][:, 0]
    return np.outer(normal, normal)


def both_sides(state: JointState) -> bool:
    """Return whether an object can bend to both sides of the plane of its mean shape.

    The relief of the mean shape is below three standard deviations of deformation:
    docs/benchmarks/README.md, "Thresholds".
    """
    across = across_plane(state.shapes[0])
    relief, *deviations = np.sum((across @ state.shapes) ** 2, axis=(1, 2))
    return bool(relief < 3.0**2 * np.sum(deviations))


def flat_cameras(problem: JointProblem, state: JointState) -> NDArray:
    """Return the best cameras (I, 2, 3) for the mean shape without its relief.

    If an object bends to both sides of a plane, this relief distorts them all.
    """
    mean = state.shapes[0]
    flat = mean - across_plane(mean) @ mean
    return problem.aligned(state._replace(shapes=flat[None])).motion


def unfolded(state: JointState, n: int) -> JointState:
    """Return a state of a flat object with relief to both sides of its plane.

    The mean shape is flat, its relief one of at most n basis shapes, which lie in the
    plane or across it. Shapes and cameras reflected in the plane give the same images.
    They replace those of half of the frames, at random.
    """
    mean, *basis = state.shapes
    across = across_plane(mean)
    along = np.eye(3) - across
    parts = np.concatenate([(across @ mean)[None], across @ basis, along @ basis])
    _, sizes, axes = np.linalg.svd(parts.reshape(len(parts), -1), full_matrices=False)
    parts = (sizes[:, None] * axes)[:n].reshape(-1, *mean.shape)
    motion = state.motion.copy()
    motion[np.random.RandomState(0).permutation(len(motion)) % 2 > 0] @= along - across
    return state._replace(shapes=np.stack([along @ mean, *parts]), motion=motion)


def stretched(
    state: JointState, camera: CameraModel, factor: float
) -> tuple[JointState, NDArray]:
    """Return depths some times as large, with rotations as many times smaller.

    The depths are those along the mean line of sight. Also returns the stretch (3, 3).
    """
    views = full_rotations(state.motion)[0][:, 2]
    sight = np.linalg.eigh(views.T @ views)[1][:, -1]
    along = np.outer(sight, sight)
    motion = camera.nearest(state.motion @ (np.eye(3) + (1 / factor - 1) * along))
    stretch = np.eye(3) + (factor - 1) * along
    return state._replace(shapes=stretch @ state.shapes, motion=motion), stretch


def other_depths(
    state: JointState, camera: CameraModel, prior: ShapePrior
) -> Iterator[tuple[JointState, ShapePrior, float]]:
    """Yield flatter and deeper states, their priors, and squared changes of depth."""
    for factor in (STEP, 1.0 / STEP):
        start, stretch = stretched(state, camera, factor)
        yield start, prior.stretched(stretch), (factor - 1.0) ** 2


def affine_start(problem: JointProblem, W: NDArray, paper: NDArray) -> JointState:
    """Return the paper's result, rigid cameras and scaled basis shapes, as a start."""
    shapes = problem.frames.coordinates(paper)
    W = problem.frames.coordinates(W)
    rows, motion = W.reshape(len(W) // 2, 2, -1), rigid_cameras(W, shapes[0].T)
    return first_state(problem, rows, motion, _scaled(rows, motion, shapes))


def best_starts(
    problem: JointProblem, table: FactorisedTable, paper: NDArray
) -> list[JointState]:
    """Return the likeliest starts, best first: three of small tables, one of others."""
    frames, limits = problem.frames, problem.settings.limits
    factors, thorough, scaled = table.factors, problem.thorough, problem.cameras.scaled
    # Frames for the comparison, spread evenly from the most to the least rigid
    rows = frames.coordinates(table.W).reshape(frames.n_frames, 2, -1)
    order = np.argsort(rigid_energy(rows, frames.coordinates(factors.rigid_shape)))
    sample = np.sort(spread(order, 400 if thorough else 200))
    # No prior: with the large noise of a start it would make basis shapes vanish.
    part = replace(problem.part(sample, tol=limits.compared_tol), penalty=0.0)
    seen, n_components = rows[sample], len(paper) - 1
    trials: list[tuple[float, JointState, NDArray]] = []

    def compare(motion: NDArray, shapes: NDArray | None = None) -> None:
        """Refine shapes, or lifted ones, with fixed cameras, and add the trial."""
        if shapes is None:
            shapes = lifted_shapes(seen, motion[sample], n_components)
        fit = held_fit(part, seen, motion[sample], shapes)
        trials.append((fit.history[-1], fit.state, motion))

    # Rigid cameras, with the paper's and with lifted basis shapes
    shapes = frames.coordinates(paper)
    motion, shapes = calibrated_start(factors.cameras, shapes, scaled)
    compare(motion, _scaled(seen, motion[sample], shapes))
    compare(motion)
    # Mixtures of more and more columns, until the objective rises. Small tables use all
    # mixtures, without and with scales, because a few steps do not identify the best
    # one.
    scales = np.linalg.norm(motion, axis=(1, 2)) / np.sqrt(2)
    families = [scales, None] if thorough else [scales]
    for divisors in families if scaled else [None]:
        before = np.inf
        for mixed in mixed_cameras(rows, divisors, sample, limits.widths):
            compare(mixed)
            if not thorough and trials[-1][0] > before:
                break
            before = trials[-1][0]
    # The best ones, with free cameras
    trials.sort(key=itemgetter(0))
    freed = []
    for _, state, motion in trials if thorough else trials[:1]:
        fit = part.refined(state, max_iter=30)
        motion = motion.copy()
        motion[sample] = fit.state.motion
        freed.append((fit.history[-1], fit.state._replace(motion=motion)))
    freed.sort(key=itemgetter(0))
    return [with_prior(problem, state) for _, state in freed[:3]]


def held_fit(
    problem: JointProblem, rows: NDArray, motion: NDArray, shapes: NDArray
) -> JointFit:
    """Return the fit of shapes after some steps with cameras held, without the prior.

    With the large noise of a start, the prior would make basis shapes vanish.
    """
    state = first_state(problem, rows, motion, shapes)
    held = replace(problem, penalty=0.0, seen_by=AffineCameras(held=True))
    return held.refined(state, max_iter=FIXED_STEPS)


def first_state(
    problem: JointProblem, rows: NDArray, motion: NDArray, shapes: NDArray
) -> JointState:
    """Return a state whose noise is a tenth of the residual of the mean shape."""
    noise = 0.1 * np.mean((rows - motion @ shapes[0]) ** 2)
    least_noise = problem.settings.limits.least_noise * problem.mean_square
    return JointState(shapes, motion, max(noise, least_noise))


def with_prior(problem: JointProblem, state: JointState) -> JointState:
    """Return a state with its basis shapes mixed and scaled to the likeliest basis."""
    shapes, motion, _ = state
    alpha = problem.likelihood(*state).alpha
    shapes = likely_basis(shapes, motion, alpha, problem.penalty)
    return state._replace(shapes=shapes)


def likely_basis(
    shapes: NDArray, motion: NDArray, alpha: NDArray, penalty: float
) -> NDArray:
    """Return the same shapes (K + 1, 3, J) in the basis of greatest likelihood.

    Without noise neither a shift of the mean shape along the basis shapes nor a mixing
    A of these changes the residual: alpha becomes ``A^-1 (alpha - mean)``. The
    remaining terms of the objective, with n frames and ``H_kl = sum_i <M_i B_k, M_i
    B_l>``, are

        n log det(A A^T) + sum_i ||A^-1 (alpha_i - mean)||^2 + penalty tr(A^T H A).

    In a basis where the covariance of the coefficients is the identity and H is
    diagonal, the minimum is the diagonal A with

        a_k^2 = 2 / (1 + sqrt(1 + 4 penalty H_kk / n)).
    """
    # Coefficients of mean zero
    mean = alpha.mean(axis=0)
    mean_shape = shapes[0] + np.tensordot(mean, shapes[1:], 1)
    # Coefficients of covariance one
    deviations = alpha - mean
    covariance = deviations.T @ deviations / len(motion)
    # A ridge, as the covariance can be singular
    covariance += (OF_PRODUCTS * np.trace(covariance) or 1.0) * np.eye(len(mean))
    basis = np.tensordot(np.linalg.cholesky(covariance).T, shapes[1:], 1)
    # Diagonal H / n, and the scales a_k
    C = camera_moments(motion)
    energy, axes = np.linalg.eigh(np.einsum("ab,kaj,lbj->kl", C, basis, basis))
    price = penalty * np.maximum(energy, 0.0)
    scale = np.sqrt(2.0 / (1.0 + np.sqrt(1.0 + 4.0 * price)))
    basis = scale[:, None, None] * np.tensordot(axes.T, basis, 1)
    return np.concatenate([mean_shape[None], basis])


def camera_moments(motion: NDArray) -> NDArray:
    """Return ``mean_i M_i^T M_i`` (3, 3) of cameras (I, 2, 3)."""
    M = frames_last(motion)
    return np.einsum("rai,rbi->ab", M, M) / len(motion)


def _scaled(rows: NDArray, motion: NDArray, shapes: NDArray) -> NDArray:
    """Return shapes (n, 3, J) over the standard deviation of their coefficients.

    Shapes are orthogonal, so least squares gives ``<M_i B_k, W_i> / ||M_i B_k||^2``.
    """
    images = np.einsum("irc,kcj->ikrj", motion, shapes[1:])
    along = np.einsum("ikrj,irj->ik", images, rows)
    energy = np.einsum("ikrj,ikrj->ik", images, images)
    alpha = np.divide(along, energy, where=energy > 0, out=np.zeros_like(along))
    return np.concatenate([shapes[:1], alpha.std(axis=0)[:, None, None] * shapes[1:]])
