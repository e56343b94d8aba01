"""Frames of a joint fit, and the marginal likelihood of their cameras and shapes.

The coefficients are integrated out.

Coefficients have the prior ``N(0, I)``. Coordinates have noise of variance s2. Write
``c = (1, alpha)`` and ``H_kl = <M B_k, M B_l>`` (k, l >= 1). Then minus twice the log
likelihood of all frames is, up to a constant ::

    N log s2 + sum_i [ min_alpha (||W_i - M_i sum_k c_k B_k||^2 / s2 + ||alpha||^2)
                       + log det(I + H_i / s2) ]

with N the number of coordinates that were seen. The objective adds minus twice the log
prior of the basis shapes: ``penalty * sum_i tr H_i`` for their images, or ``sum_kj
B_kj^T P_k B_kj`` for their points in space, with precisions P_k, where points count by
their shares of the observations. With calibrated cameras it adds the prior of the
extents (`extent_penalty`).

Positions are eliminated by least squares: tracks and shapes are centred over the seen
points of each frame. Without weights the given shapes have to be centred already.

The gradient follows from the first two posterior moments of the coefficients, as in
expectation maximisation (Tipping, Bishop, "Probabilistic principal component analysis",
1999; Bishop, "Pattern recognition and machine learning", 2006, section 12.2).

If no point is missing, the objective depends on a frame only through its energy and its
products with directions that span the shapes: cheap for any number of points.

All terms are sums over blocks of frames. Inside a block the frame is the last index.
Cameras M and their gradient G are (2, 3, n_frames).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from operator import add
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import _linalg as linalg
from isa_nrsfm._compat.lazy import cached_property
from isa_nrsfm._frames.search import (
    FrameTracks,
    ShapeProducts,
    camera_gram,
    coefficient_posterior,
    frame_sums,
    frame_tracks,
    joined_frames,
)
from isa_nrsfm._joint.prior import ShapePrior
from isa_nrsfm._tables import BLOCK_FRAMES, FrameBlocks, seen_points

# Without the penalty, frontal photos of faces give needle-like shapes. If one extent is
# five times both others, it is as large as that of a ratio of the arithmetic to the
# geometric mean of the squared extents with weight 0.02, which thickens flat objects.
EXTENT_WEIGHT = 0.011
# Floor of the squared extents, as a share of their mean. Flat objects stay flat.
FLAT = 1e-3

# Rows (n, 2, J), NaN where a point is missing, and weights (n, J), zero there.
WeightedRows = tuple[NDArray, NDArray]


def without(rows: NDArray, left_out: NDArray | bool = False) -> WeightedRows:
    """Return rows (n, 2, J), with weight zero for missing points and those left out."""
    return rows, (seen_points(rows) & np.logical_not(left_out)) * 1.0


@dataclass(frozen=True, eq=False)
class JointFrames:
    """Frames of a table, ready for passes over them.

    All blocks of FrameTracks have weights, or none has. Directions (n_directions, J)
    are orthonormal rows, None if frames are given by their points. `repeated`: a weight
    is the number of observations of its point, otherwise each point is one.
    """

    blocks: FrameBlocks
    directions: NDArray | None = None
    repeated: bool = False

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.blocks.n_frames

    @cached_property
    def totals(self) -> tuple[float, float]:
        """Number of observed coordinates of positive weight, and weighted energy."""
        repeated = self.repeated

        def of_block(block: FrameTracks) -> tuple[float, float]:
            n_seen = block.weight.sum()
            if block.weights is not None and not repeated:
                n_seen = np.count_nonzero(block.weights)
            return 2.0 * n_seen, block.energy.sum()

        n_seen, square = np.sum(list(self.blocks.map(of_block)), axis=0)
        return float(n_seen), float(square)

    @cached_property
    def point_shares(self) -> NDArray | None:
        """Observations of each point (J,) over their mean; one if not `repeated`.

        Zero for points that no frame shows. None without weights.
        """
        blocks = [block.weights for block in self.blocks.map(lambda block: block)]
        if blocks[0] is None:
            return None
        weights = sum(block.sum(axis=1) for block in blocks)
        return weights / weights.mean() if self.repeated else (weights > 0) * 1.0

    def basis_penalty(self, basis_std: float) -> float:
        """Compute the factor of ``sum_i ||M_i B_k||^2`` in the prior of basis shapes.

        `basis_std` is relative to the root mean square of the coordinates. The prior
        counts once, not for each frame.
        """
        n_numbers, energy = self.totals
        return n_numbers / (basis_std**2 * energy * self.n_frames)

    @classmethod
    def from_points(
        cls, rows: FrameBlocks, complete: bool, observations: NDArray | None = None
    ) -> Self:
        """Return frames by points, from rows (n, 2, J) and observations (I, J)."""
        if observations is not None:
            return cls(rows.derive(frame_tracks, observations), repeated=True)
        if complete:
            return cls(rows.derive(frame_tracks))
        return cls(rows.derive(lambda rows: frame_tracks(*without(rows))))

    @classmethod
    def of_rows(cls, rows: NDArray, observations: NDArray | None = None) -> Self:
        """Return rows (n, 2, J) by points, with observations (n, J), as one block."""
        complete = bool(np.isfinite(rows).all())
        block = FrameBlocks.of_blocks([rows], [len(rows)])
        return cls.from_points(block, complete, observations)

    @classmethod
    def from_weighted(cls, weighted: FrameBlocks) -> Self:
        """Return frames by points, from blocks of `WeightedRows`."""
        return cls(weighted.derive(lambda block: frame_tracks(*block)))

    @classmethod
    def from_directions(cls, rows: FrameBlocks, directions: NDArray) -> Self:
        """Return complete rows (I, 2, J) by products with directions of sum zero."""

        def compressed(rows: NDArray) -> FrameTracks:
            n, _, n_points = rows.shape
            products = (rows.reshape(2 * n, -1) @ directions.T).reshape(n, 2, -1)
            W, weight = np.ascontiguousarray(products.T), np.full(n, float(n_points))
            return FrameTracks(W, None, np.zeros((2, n)), weight, linalg.energies(rows))

        blocks = rows.derive(compressed)
        return cls(blocks.regrouped(joined_frames, BLOCK_FRAMES), directions)

    def coordinates(self, shapes: NDArray) -> NDArray:
        """Return shapes (..., n_points) by directions, if the frames are given so."""
        return shapes if self.directions is None else shapes @ self.directions.T

    def points(self, shapes: NDArray) -> NDArray:
        """Return shapes (..., n_points) from the result of `coordinates`."""
        return shapes if self.directions is None else shapes @ self.directions

    def centred(self, shapes: NDArray) -> NDArray:
        """Return shapes centred over their points. Directions have sum zero already."""
        return linalg.centred(shapes) if self.directions is None else shapes

    def take(self, frames: NDArray) -> Self:
        """Return some of the frames, in the order of the table."""
        chosen = np.isin(np.arange(self.n_frames), frames)
        parts = self.blocks.map(
            lambda block, kept: linalg.of_frames(block, np.flatnonzero(kept)), chosen
        )
        taken = [part for part in parts if len(part.weight)]
        lengths = [len(part.weight) for part in taken]
        blocks = FrameBlocks.of_blocks(taken, lengths, self.blocks.n_threads)
        return replace(self, blocks=blocks.regrouped(joined_frames, BLOCK_FRAMES))


# Terms that are summed over frames, and those of each frame, in the order below
Terms = tuple[tuple[Any, ...], tuple[NDArray, ...]]


class LikelihoodTerms(NamedTuple):
    """Objective, derivatives and posterior moments, from one pass over the frames.

    noise_gradient: derivative of the value by the logarithm of the noise variance.
    shape_gradient (n_shapes, 3, J): derivative with respect to the shapes.
    shape_curvature (J or 1, 3 n_shapes, 3 n_shapes): ``sum_i w_ij E_i (x) M_i^T M_i``
    with the posterior second moments E_i of (1, alpha). Times ``2 / s2`` it is the
    Hessian by point j of the shapes, posterior and positions held fixed. One matrix for
    all points if all weights are one.
    residual: sum of squared residuals of the tracks at the posterior means.
    motion_gradient (2, 3, I): derivative with respect to the cameras.
    motion_curvature (6, I): ``sum_kl E_kl B_k B_l^T``, packed: the same for each row.
    alpha (I, K): posterior means of the coefficients.
    """

    value: float
    noise_gradient: float
    shape_gradient: NDArray
    shape_curvature: NDArray
    residual: float
    motion_gradient: NDArray
    motion_curvature: NDArray
    alpha: NDArray


class MarginalLikelihood(NamedTuple):
    """The objective and its derivatives, as a sum over blocks of frames.

    penalty: factor of ``sum_i tr H_i``, or factors (K,) of its terms. precisions (K, 3,
    3): P_k, if any.
    extent_weight: weight of the prior of the extents, for each coordinate.
    prior: that of the shapes, by a fitted model.
    n_unknowns: number of coordinates that determine parameters, not the noise.
    """

    frames: JointFrames
    penalty: NDArray | float = 0.0
    extent_weight: float = 0.0
    prior: ShapePrior | None = None
    n_unknowns: float = 0.0
    precisions: NDArray | None = None

    def __call__(
        self, shapes: NDArray, motion: NDArray, noise: float
    ) -> LikelihoodTerms:
        """Return the terms at shapes (n, 3, J), motion (I, 2, 3), noise variance s2."""
        products, (n_seen, _) = ShapeProducts(shapes), self.frames.totals

        def over_block(block: FrameTracks, motion: NDArray) -> Terms:
            """Return the sums over pieces whose matrices fit the cache."""
            M, pieces = linalg.frames_last(motion), block.pieces(len(shapes))
            return _joined(
                self._terms(piece, M[:, :, frames], products, noise)
                for frames, piece in pieces
            )

        sums, by_frame = _joined(self.frames.blocks.map(over_block, motion))
        value, noise_gradient, shape_gradient, packed, residual = sums
        *of_cameras, alpha = by_frame
        # Matrices (n, size, size) from the sums, packed by shapes and by axes
        size = 3 * len(shapes)
        curvature = linalg.unpack3(linalg.unpacked(packed)).transpose(4, 0, 2, 1, 3)
        curvature = curvature.reshape(-1, size, size)
        columns = shapes.reshape(size, -1).T[:, :, None]
        pulled = (curvature @ columns)[:, :, 0].T.reshape(shapes.shape)
        freedom = n_seen - self.n_unknowns
        value += freedom * np.log(noise)
        shape_gradient = shape_gradient + (2 / noise) * pulled
        if self.extent_weight:
            weight = self.extent_weight * n_seen
            term, slope = extent_penalty(shapes, self.frames.point_shares)
            value += weight * term
            shape_gradient = shape_gradient + weight * slope
        if self.precisions is not None:
            shares = self.frames.point_shares
            shares = np.ones(1) if shares is None else shares
            slope = shares * (self.precisions @ shapes[1:])
            value += np.vdot(slope, shapes[1:])
            shape_gradient[1:] += 2.0 * slope
            blocks = curvature.reshape(-1, len(shapes), 3, len(shapes), 3)
            blocks = np.einsum("jkakb->jkab", blocks)[:, 1:]  # a view
            blocks += noise * shares[:, None, None, None] * self.precisions
        if self.prior is not None:
            term, slope = self.prior.term(shapes)
            value, shape_gradient = value + term, shape_gradient + slope
        noise_gradient, alpha = float(noise_gradient + freedom), alpha.T.copy()
        sums = float(value), noise_gradient, shape_gradient, curvature, residual
        return LikelihoodTerms._make((*sums, *of_cameras, alpha))

    def _terms(
        self, block: FrameTracks, M: NDArray, shapes: ShapeProducts, noise: float
    ) -> Terms:
        """Return the sums over frames of a block, with cameras M (2, 3, n_frames).

        The curvature of the shapes is packed: (n_pairs, 6, n_points or 1).
        """
        n_shapes, _, n_points = shapes.shapes.shape
        n_seen, square = self.frames.totals
        products = frame_sums(block, shapes)
        # If the noise is tiny, refine the solution of the normal equations by one step.
        tiny = noise * n_seen < 1e-7 * square
        posterior = coefficient_posterior((products, noise), M, refined=tiny)
        c, alpha = posterior.c, posterior.alpha
        penalty = np.reshape(self.penalty, (-1, 1))
        value = np.sum(posterior.objective / noise + posterior.log_determinant)
        value += np.sum(penalty * posterior.image_energy)
        residual = float(posterior.residual.sum())
        spread = float(posterior.spread.sum())

        # Second moments E of c. The penalty acts as if E_kk were larger by s2 penalty.
        moments = posterior.second_moments()
        moments[linalg.diagonal_of(moments)[1:]] += noise * penalty
        cameras = camera_gram(M)
        # By the cameras: M A - sum_k c_k P_k^T with A = sum_kl E_kl B_k B_l^T
        motion_curvature, G = posterior.by_cameras(moments)
        # By the shapes: sum_i X_i^T W_i with X_i = c_i^T (x) M_i
        X = (c[:, None, None] * M.swapaxes(0, 1)).reshape(3 * n_shapes, -1)
        shape_gradient = X @ block.deviations.reshape(n_points, -1).T
        if block.weights is None:
            shape_curvature = (moments @ cameras.T)[:, :, None]
        else:
            pairs = (moments[:, None] * cameras).reshape(6 * len(moments), -1)
            shape_curvature = (pairs @ block.weights.T).reshape(-1, 6, n_points)
            # The eliminated position of a frame depends on the means of the shapes.
            middles = products.shape_centroid
            mixed = np.einsum("kli,lbi->kbi", linalg.unpacked(moments), middles)
            means = np.einsum("abi,kbi->kai", linalg.unpack3(cameras), mixed)
            shape_gradient += means.reshape(3 * n_shapes, -1) @ block.weights.T
        noise_gradient = -(residual + spread) / noise
        shape_gradient = (-2 / noise) * shape_gradient.reshape(shapes.shapes.shape)
        sums = float(value), noise_gradient, shape_gradient, shape_curvature, residual
        return sums, ((2 / noise) * G, motion_curvature, alpha)


def _joined(parts: Iterable[Terms]) -> Terms:
    """Add the sums of consecutive frames, and concatenate the terms of each frame."""
    sums: Any = None
    by_frame: list[Any] = []
    for added, terms in parts:
        sums = added if sums is None else tuple(map(add, sums, added))
        by_frame.append(terms)
    if len(by_frame) == 1:  # no copies
        return sums, terms
    join = partial(np.concatenate, axis=-1)
    return sums, tuple(map(join, zip(*by_frame, strict=True)))


def extent_penalty(
    shapes: NDArray, shares: NDArray | None = None
) -> tuple[float, NDArray]:
    """Compute the penalty of shapes (n, 3, J) and its gradient, for N weight 1.

    Points count by their shares (J,): otherwise the penalty would move those of tiny
    weights far away. Without shares the shapes are centred already.

    If an object hardly turns, its images determine the depth only to second order.
    Depths c times as large with rotations c times smaller give nearly the same images
    (bas-relief ambiguity: Belhumeur, Kriegman, Yuille, 1999). Unmodelled deformation
    then dominates the estimated depth. With the second moments ``G = sum_k B_k B_k^T``
    of all shapes the objective contains, for N coordinates, ::

        N weight ((tr G)^2 / (3 e2(G)) - 1),   e2(G) = ((tr G)^2 - tr G^2) / 2,

    with the second elementary symmetric function e2 of the squared extents. The penalty
    is zero for equal extents and grows for needles, with one large extent; flat objects
    have a third of the mean. It grows with N like the misfit.
    """
    B = shapes
    if shares is not None:
        mean = (shares * B).mean(axis=2, keepdims=True) / shares.mean()
        B = np.sqrt(shares) * (B - mean)
    G = np.einsum("kaj,kbj->ab", B, B)
    trace = float(np.trace(G))
    if not trace > 0:
        return 0.0, np.zeros_like(B)
    # Second elementary symmetric function of the squared extents
    pairs = (trace**2 - np.sum(G**2)) / 2 + FLAT * trace**2
    ratio = trace**2 / (3.0 * pairs) * (1 + 3 * FLAT)
    one = np.eye(3)
    slope = (2.0 / trace) * one - (trace * one - G + 2 * FLAT * trace * one) / pairs
    gradient = (ratio * slope) @ B
    if shares is not None:
        gradient = np.sqrt(shares) * gradient
    return ratio - 1.0, 2.0 * gradient
