"""Frames of the joint refinement, represented by points or by directions.

If no point is missing, the objective depends on a frame only through its energy and its
products with directions that span the shapes: cheap for any number of points.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import FrameTracks, frame_tracks, joined_frames
from isa_nrsfm._linalg.small_matrices import energies, of_frames
from isa_nrsfm._tables.blocks import BLOCK_FRAMES, FrameBlocks
from isa_nrsfm._tables.tracks import seen_points

# Rows (n, 2, J), NaN where a point is missing, and weights (n, J), zero there.
WeightedRows = tuple[NDArray, NDArray]


def without(rows: NDArray, left_out: NDArray) -> WeightedRows:
    """Return rows (n, 2, J), with weight zero for missing points and those left out."""
    return rows, (seen_points(rows) & ~left_out) * 1.0


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
        totals = partial(_totals, repeated=self.repeated)
        n_seen, square = np.sum(list(self.blocks.map(totals)), axis=0)
        return float(n_seen), float(square)

    def basis_penalty(self, basis_std: float) -> float:
        """Compute the factor of ``sum_i ||M_i B_k||^2`` in the prior of basis shapes.

        `basis_std` is relative to the root mean square of the coordinates. The prior
        counts once, not for each frame.
        """
        n_numbers, energy = self.totals
        return n_numbers / (basis_std**2 * energy * self.n_frames)

    @classmethod
    def from_points(cls, rows: FrameBlocks, complete: bool) -> Self:
        """Return frames by points, from blocks of rows (n, 2, J); weights are one."""
        return cls(rows.derive(partial(_plain_frames, complete=complete)))

    @classmethod
    def from_weighted(cls, weighted: FrameBlocks) -> Self:
        """Return frames by points, from blocks of `WeightedRows`."""
        return cls(weighted.derive(lambda block: frame_tracks(*block)))

    @classmethod
    def from_repeated(cls, rows: FrameBlocks, weights: NDArray) -> Self:
        """Return frames by points, from rows (n, 2, J) and observations (I, J)."""
        return cls(rows.derive(frame_tracks, weights), repeated=True)

    @classmethod
    def from_directions(cls, rows: FrameBlocks, directions: NDArray) -> Self:
        """Return complete rows (I, 2, J) by products with directions of sum zero."""
        blocks = rows.derive(partial(_compressed_frames, directions=directions))
        return cls(blocks.regrouped(joined_frames, BLOCK_FRAMES), directions)

    def coordinates(self, shapes: NDArray) -> NDArray:
        """Return shapes (..., n_points) by directions, if the frames are given so."""
        return shapes if self.directions is None else shapes @ self.directions.T

    def points(self, shapes: NDArray) -> NDArray:
        """Return shapes (..., n_points) from the result of `coordinates`."""
        return shapes if self.directions is None else shapes @ self.directions

    def take(self, frames: NDArray) -> Self:
        """Return some of the frames, in the order of the table."""
        chosen = np.zeros(self.n_frames, dtype=bool)
        chosen[frames] = True
        parts = self.blocks.map(
            lambda block, kept: of_frames(block, np.flatnonzero(kept)), chosen
        )
        taken = [part for part in parts if len(part.weight)]
        blocks = FrameBlocks.of_blocks(taken, [len(part.weight) for part in taken])
        return replace(self, blocks=blocks.regrouped(joined_frames, BLOCK_FRAMES))


def _totals(block: FrameTracks, repeated: bool) -> tuple[float, float]:
    """Return the number of observed coordinates of a block, and its energy."""
    n_seen = block.weight.sum()
    if block.weights is not None and not repeated:
        n_seen = np.count_nonzero(block.weights)
    return 2.0 * n_seen, block.energy.sum()


def _plain_frames(rows: NDArray, complete: bool) -> FrameTracks:
    """Return frames of rows (n_frames, 2, n_points), missing points of weight zero."""
    return frame_tracks(rows, None if complete else seen_points(rows) * 1.0)


def _compressed_frames(rows: NDArray, directions: NDArray) -> FrameTracks:
    """Return complete frames (I, 2, J) with directions in the place of points."""
    n_frames, _, n_points = rows.shape
    products = (rows.reshape(2 * n_frames, -1) @ directions.T).reshape(n_frames, 2, -1)
    return FrameTracks(
        np.ascontiguousarray(products.transpose(2, 1, 0)),
        None,
        np.zeros((2, n_frames)),
        np.full(n_frames, float(n_points)),
        energies(rows),
    )
