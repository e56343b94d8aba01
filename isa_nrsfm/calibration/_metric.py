"""The metric of space in which affine cameras are most nearly scaled rotations.

A factorisation into affine cameras and shapes is known up to one 3x3 affinity of
space. Cameras are scaled orthographic (weak perspective) in some metric of space if
objects are small and pixels square. This determines the metric (Tomasi, Kanade 1992;
Poelman, Kanade, "A paraperspective factorization method for shape and motion recovery",
1997): a symmetric positive definite matrix ``G = Q Q^T`` such that ``M_i Q`` are nearly
the first two rows of scaled rotations. Q is known up to a rotation. The metric may
change with the deformation of the object, as ``G_i = Q exp(sum_k alpha_ik E_k) Q^T``
with symmetric strains E_k.

The sum of squares of the residuals (`linearised`) is minimised by damped
Gauss-Newton steps along geodesics, ``Q <- Q exp(E_0 / 2)``, and in the strains. So ``Q
Q^T`` stays positive definite, even if the linear equations (`metric_quadric`) have an
indefinite solution. The derivative of the exponential is that of Daleckii and Krein
(Higham, "Functions of matrices", 2008, theorem 3.11).

The strain of a frame, ``sum_k alpha_ik E_k``, has five or six coordinates in
`strain_basis`. Derivatives with respect to those of E_k are alpha_ik times derivatives
with respect to these.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import gen_batches

from isa_nrsfm._linalg import OF_PRODUCTS, OF_RANKS, OF_STEPS
from isa_nrsfm._parameters import CalibratedCamera
from isa_nrsfm._tables import BLOCK_FRAMES

# Bound on the ratio of stretches of space by a root Q of the metric G. It is exceeded
# if the cameras hardly determine the depth, which noise can then stretch without limit:
# docs/benchmarks/README.md, "Thresholds".
LARGEST_STRETCH = 20.0

# Bound on the ratio of stretches of a metric to start from, in the space in which the
# cameras see all directions alike. Nearly singular metrics are near saddle points:
# docs/benchmarks/README.md, "Thresholds".
STRETCH_OF_START = 3.0

# Matrices whose products with ``[[xx, xy], [xy, yy]]`` are xx - yy, 2 xy and xx + yy.
ROW_PRODUCTS = np.array([[[1.0, 0, 1], [0, 1, 0]], [[0, 1, 0], [-1, 0, 1]]])


def unit_cameras(motion: NDArray) -> NDArray:
    """Return the usable cameras, each divided by its Frobenius norm."""
    size = np.linalg.norm(motion, axis=(1, 2))
    usable = np.isfinite(size) & (size > 0)
    if not usable.any():
        raise ValueError(
            "the viewing frame needs at least one finite, non-zero camera; "
            f"got none among the {len(motion)} cameras"
        )
    return motion[usable] / size[usable, None, None]


def mean_gram(cameras: NDArray) -> NDArray:
    """Return the mean of M_i^T M_i over the cameras."""
    rows = cameras.reshape(-1, 3)
    return rows.T @ rows / len(cameras)


def symmetric_power(matrix: NDArray, power: float) -> NDArray:
    """Return a power of a symmetric positive semidefinite matrix."""
    eigenvalues, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(eigenvalues, 0) ** power) @ vectors.T


def strain_basis(camera: CalibratedCamera) -> NDArray:
    """Return an orthonormal basis of the strains that change the residuals.

    Six symmetric matrices for orthographic cameras. Five with trace zero for
    weak-perspective ones, as the trace only changes the scales of the frames.
    """
    basis = np.zeros((6, 3, 3))
    diagonal = np.array([[1, -1, 0], [1, 1, -2], [1, 1, 1]]) / np.sqrt([[2], [6], [3]])
    basis[[[0], [1], [5]], [0, 1, 2], [0, 1, 2]] = diagonal
    first, second = [0, 0, 1], [1, 2, 2]
    basis[[2, 3, 4], first, second] = basis[[2, 3, 4], second, first] = np.sqrt(0.5)
    return basis if camera == "orthographic" else basis[:5]


def conformal_equations(cameras: NDArray) -> NDArray:
    """Return the linear equations of weak-perspective cameras for the metric of space.

    For cameras (I, 2, 3) with rows m1 and m2 these are the coefficients (2 I, 6) of
    ``m1 G m1^T - m2 G m2^T`` and of ``2 m1 G m2^T`` in the coordinates of G in
    `strain_basis`. Rotating a frame in the image mixes the two.
    """
    basis = strain_basis("orthographic")
    (xx, xy), (_, yy) = np.einsum("ira,nab,isb->rsin", cameras, basis, cameras)
    return np.vstack([xx - yy, 2 * xy])


def metric_quadric(motion: NDArray) -> NDArray | None:
    """Find the symmetric G under which cameras (I, 2, 3) are weak-perspective ones.

    The equations of `conformal_equations` are solved by least squares, with the mean of
    ``m1 G m1^T + m2 G m2^T`` fixed to one. With a fixed norm of G, a direction that the
    cameras hardly see would nearly solve them. Returns None if they do not determine G,
    or if G is not safely positive definite.
    """
    cameras = unit_cameras(motion)
    gram = mean_gram(cameras)
    if np.linalg.matrix_rank(gram, rtol=OF_RANKS, hermitian=True) < 3:
        return None
    # In coordinates where the mean of M_i^T M_i is the identity, the fixed mean is the
    # trace of G. So G is I / 3 plus a matrix of trace zero with five unknowns.
    whitening = symmetric_power(gram, -0.5)
    equations = conformal_equations(cameras @ whitening)
    unknowns, _, rank, _ = np.linalg.lstsq(
        equations[:, :5], -equations[:, 5] / np.sqrt(3), rcond=1e-6
    )
    if rank < 5:
        return None
    G = np.tensordot(unknowns, strain_basis("weak_perspective"), 1) + np.eye(3) / 3
    G = whitening @ G @ whitening
    # Eigenvalues of G are squares of the stretches of space.
    eigenvalues = np.linalg.eigvalsh(G)
    return G if eigenvalues[0] * LARGEST_STRETCH**2 > eigenvalues[-1] else None


# A metric of least residuals: Q with ``G = Q Q^T`` and the strains E_k, symmetric with
# trace zero (K + 1, 3, 3); the sum of the squared residuals; and ``J^T J`` with the
# Jacobian of the residuals in the coordinates of E_0, E_1, ... in `strain_basis`, plus
# the ridge of the strains.
MetricFit = tuple[NDArray, float, NDArray]


def linearised(
    MQ: NDArray, alpha: NDArray, strain: NDArray, camera: CalibratedCamera
) -> tuple[NDArray, NDArray]:
    """Return the residuals (m,) of cameras ``M_i Q`` (I, 2, 3), and their Jacobian.

    The residuals are those of the products ``xx, xy, yy`` of the rows in the metric.
    For weak-perspective cameras ``(xx - yy, 2 xy) / (xx + yy)``, with the norm ``(s1^2
    - s2^2) / (s1^2 + s2^2)``, s1 and s2 being the singular values of ``M_i Q``: it does
    not depend on roll and scale. For orthographic cameras ``(xx - yy, 2 xy, xx + yy -
    2) / sqrt(2)``, with the norm ``||M_i G M_i^T - I||_F``. The Jacobian (m, n (K + 1))
    is that by the coordinates of E_0, E_1, ... in `strain_basis`.
    """
    basis = strain_basis(camera)
    # exp(E_0 / 2) exp(E) exp(E_0 / 2) changes to first order by the symmetric part of
    # E_0 exp(E), where E = sum_k alpha_ik E_k.
    grown, strain_terms = MQ, list[NDArray]()
    if len(strain):
        values, axes = np.linalg.eigh(np.tensordot(alpha, strain, 1))
        seen = MQ @ axes
        grown = (seen * np.exp(values)[:, None]) @ axes.mT  # M_i Q exp(E)
        # In the axes of E its exponential changes by dE times, entry by entry, the
        # divided differences of exp at two eigenvalues, which are exp((a + b) / 2)
        # sinh((a - b) / 2) / ((a - b) / 2).
        a, b = values[:, :, None] / 2, values[:, None] / 2
        divided = np.exp(a + b) * np.sinc(1j * (a - b) / np.pi).real
        weights = np.einsum("ipa,pqc,iqb->icab", seen, ROW_PRODUCTS, seen)
        weights = axes[:, None] @ (divided[:, None] * weights) @ axes[:, None].mT
        strain_terms = [np.tensordot(weights, basis, ((2, 3), (1, 2)))]
    rows = (MQ @ np.hstack([*basis])).reshape(len(MQ), -1, 3)
    products = (rows @ grown.mT).reshape(len(MQ), 2, -1, 2)
    common = np.tensordot(products, ROW_PRODUCTS, ((1, 3), (0, 1))).mT  # (I, c, n)
    entries = np.tensordot(grown @ MQ.mT, ROW_PRODUCTS)
    changes = np.concatenate([common, *strain_terms], axis=2)
    if camera == "orthographic":
        residuals, slopes = (entries - [0, 0, 2]) / np.sqrt(2), changes / np.sqrt(2)
    else:  # a quotient
        residuals = entries[:, :2] / entries[:, 2:]
        slopes = changes[:, :2] - changes[:, 2:] * residuals[:, :, None]
        slopes /= entries[:, 2:, None]
    parts = np.split(slopes[:, :, None], 1 + len(strain_terms), axis=3)
    J = np.concatenate([parts[0], alpha[:, None, :, None] * parts[-1]], axis=2)
    return residuals.ravel(), J.reshape(residuals.size, -1)


def normal_equations(r: NDArray, J: NDArray) -> tuple[float, NDArray, NDArray]:
    """Return the cost of residuals r, ``J^T J`` and ``J^T r``."""
    return float(r @ r), J.T @ J, J.T @ r


def levenberg_marquardt(
    evaluated: Callable[[NDArray], tuple[float, NDArray, NDArray]],
    moved: Callable[[NDArray, NDArray], NDArray],
    state: NDArray,
    *,
    max_steps: int,
    shortest_step: float = 0.0,
    least_gain: float = -np.inf,
) -> tuple[NDArray, float, NDArray]:
    """Minimise a sum of squares; return the last state, its cost and ``J^T J``.

    `evaluated` returns the cost of a state, ``J^T J`` and ``J^T r``; `moved` the state
    after a step (n_unknowns,). The iteration ends when no entry of a step is larger
    than `shortest_step`, or a step gains less than a share `least_gain` of the cost.
    """
    cost, curvature, gradient = evaluated(state)
    identity = np.eye(len(gradient))
    damping = 1e-3  # relative to the mean curvature
    for _ in range(max_steps):
        # Where the curvature is zero, any damping makes the matrix invertible.
        scale = np.trace(curvature) / len(gradient) or 1.0
        step = -np.linalg.solve(curvature + damping * scale * identity, gradient)
        trial = moved(state, step)
        reached, *derivatives = evaluated(trial)
        ended = np.abs(step).max() < shortest_step or damping > 1e8
        if reached <= cost * (1 + OF_PRODUCTS):
            ended |= cost - reached <= least_gain * cost or reached < OF_STEPS**2
            state, cost, (curvature, gradient) = trial, reached, derivatives
            damping = max(0.1 * damping, 1e-10)
        else:
            damping *= 4.0
        if ended:
            break
    return state, cost, curvature


def safe_start(motion: NDArray, G: NDArray, camera: CalibratedCamera) -> NDArray:
    """Return Q of a positive definite metric near to a symmetric G, to start from.

    In coordinates where the mean of ``M_i^T M_i`` is the identity, it has the axes of
    G. Its stretches have ratios of at most `STRETCH_OF_START`. Only orthographic
    cameras fix its scale.
    """
    counted = motion if camera == "orthographic" else unit_cameras(motion)
    root = symmetric_power(mean_gram(counted), 0.5)
    values, axes = np.linalg.eigh(root @ G @ root)
    values = np.maximum(values, values[-1] / STRETCH_OF_START**2)
    # Scale: the mean of tr(M_i G M_i^T) is 2, that of two rows of unit length.
    values *= 2 / values.sum()
    return np.linalg.solve(root, axes * np.sqrt(values))


def refine_metric(
    motion: NDArray,
    alpha: NDArray,
    start: NDArray,
    camera: CalibratedCamera,
    ridge: float = 0.0,
    shortest_step: float = 1e-9,
) -> MetricFit:
    """Minimise ``sum_i |residuals_i|^2 + ridge * sum_k ||E_k||_F^2`` from a metric.

    Cameras (I, 2, 3) are finite and not zero, alpha is (I, K), the start (K + 1, 3, 3).
    """
    # The unknowns of a step are coordinates in this basis: of E_0, which is zero at
    # each iterate, and of the strains E_k.
    basis = strain_basis(camera)
    ridges = np.repeat([0.0, ridge], len(basis) * np.array([1, alpha.shape[1]]))
    gram = np.einsum("ira,irb->ab", motion, motion)
    # Bound of the change of the metric of a frame by one entry of a step
    reach = 1.0 + np.abs(alpha).sum(axis=1).max(initial=0.0)

    def evaluated(metric: NDArray) -> tuple[float, NDArray, NDArray]:
        """Return the objective; infinite where space hardly has depth."""
        Q, strain = metric[0], metric[1:]
        terms = [
            normal_equations(*linearised(motion[part] @ Q, alpha[part], strain, camera))
            for part in gen_batches(len(motion), BLOCK_FRAMES)
        ]
        cost, curvature, gradient = (sum(parts) for parts in zip(*terms, strict=True))
        numbers = np.einsum("kab,nab->kn", metric, basis).ravel()
        values = np.linalg.eigvalsh(Q.T @ gram @ Q)
        deep = values[0] > OF_RANKS * values[-1]
        objective = float(cost + ridges @ numbers**2) if deep else np.inf
        return objective, curvature + np.diag(ridges), gradient + ridges * numbers

    def moved(metric: NDArray, step: NDArray) -> NDArray:
        """Return the metric after a step that changes no log metric by more than 2."""
        step = step * min(1.0, 2.0 / max(reach * np.abs(step).max(), 1e-300))
        changes = np.tensordot(step.reshape(-1, len(basis)), basis, 1)
        values, axes = np.linalg.eigh(changes[0] / 2)
        Q = metric[0] @ ((axes * np.exp(values)) @ axes.T)
        return np.concatenate([Q[None], metric[1:] + changes[1:]])

    metric, cost, curvature = levenberg_marquardt(
        evaluated, moved, start, max_steps=200, shortest_step=shortest_step
    )
    cost -= ridge * float(np.sum(metric[1:] ** 2))
    return metric, cost, curvature
