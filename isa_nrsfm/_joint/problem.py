"""The joint fit as an optimisation problem: frames, penalty and stopping rule."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.calibrated_newton import CalibratedSearch
from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._frames.models import frame_search
from isa_nrsfm._frames.point_sums import FrameTracks, frame_sums
from isa_nrsfm._joint.extents import EXTENT_WEIGHT
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.likelihood import MarginalLikelihood
from isa_nrsfm._joint.options import JOINT_OPTIONS, JointOptions
from isa_nrsfm._joint.quasi_newton import JointFit, JointState, refine_joint
from isa_nrsfm._paper.factors import Factorisation
from isa_nrsfm._paper.sample import Sample
from isa_nrsfm._paper.svd import Triplets
from isa_nrsfm._tables.blocks import BLOCK_FRAMES, FrameBlocks


class FactorisedTable(NamedTuple):
    """A table that is ready for a fit.

    rows: centred frames (I, 2, J) of size one, NaN where a point is missing.
    completed: the same with missing points and outliers filled in.
    n_seen (I,): number of visible points.
    weights (I, J): numbers of observations of the points; None where each has one.
    outliers (I, J): points that a robust loss leaves out at first; None for other
    losses.
    triplets: the 3K + 3 largest singular values of the completed table, and the rest.
    sample, factors: frames of the first steps, and factors of their matrix.
    """

    rows: FrameBlocks
    completed: FrameBlocks
    n_seen: NDArray
    outliers: NDArray | None
    triplets: Triplets
    sample: Sample
    factors: Factorisation
    weights: NDArray | None = None


class JointSettings(NamedTuple):
    """Settings of the joint fit, as in `AffineNRSfM` and `refine_joint`."""

    camera: str
    loss: str
    max_iter: int
    tol: float
    on_step: Callable[[], None] | None = None
    options: JointOptions = JOINT_OPTIONS


@dataclass(frozen=True, eq=False)
class JointProblem:
    """The objective of the joint fit of some frames, and the steps that minimise it.

    thorough: whether many starts are compared, as for small tables.
    penalty: factor of the prior of the basis shapes, or one (K,) for each.
    """

    frames: JointFrames
    settings: JointSettings
    thorough: bool = False
    penalty: NDArray | float = 0.0

    def part(self, chosen: NDArray, tol: float) -> "JointProblem":
        """Return the problem of a sample of the frames, with another tolerance."""
        frames, settings = self.frames.take(chosen), self.settings._replace(tol=tol)
        return JointProblem(frames, settings, False, self.penalty)

    @property
    def mean_square(self) -> float:
        """Mean square of the visible coordinates."""
        n_seen, energy = self.frames.totals
        return energy / n_seen

    @cached_property
    def likelihood(self) -> MarginalLikelihood:
        """The objective."""
        return MarginalLikelihood(self.frames, self.penalty)

    def aligned(self, state: JointState, camera: str) -> JointState:
        """Return a state with nearly optimal cameras for its centred shapes."""
        shapes = state.shapes
        if self.frames.directions is None:
            shapes = shapes - shapes.mean(axis=2, keepdims=True)
        search = frame_search(camera, shapes)
        motion = self.frames.blocks.joined(
            lambda block: (
                search.fit(block, state.noise, covariances=False, rough=True).motion
            )
        )
        return JointState(shapes, motion, state.noise)

    def reversed_back(
        self, state: JointState, cameras: CameraModel
    ) -> tuple[JointState, int]:
        """Return a state without frames that are reversed in depth, and their number.

        The search for each frame is repeated from its camera reversed in depth. The
        result is used if its objective is lower.
        """
        function = partial(
            _reversed_back,
            search=CalibratedSearch(state.shapes, cameras.scaled),
            noise=state.noise,
        )
        found = self.frames.blocks.map(function, state.motion)
        motion, better = map(np.concatenate, zip(*found, strict=True))
        return state._replace(motion=motion), int(better.sum())

    def refined(
        self,
        state: JointState,
        cameras: CameraModel,
        least_noise: float | None = None,
        max_iter: int | None = None,
        tol: float | None = None,
    ) -> JointFit:
        """Refine a state jointly, by default with the settings of the problem."""
        settings, likelihood = self.settings, self.likelihood
        if tol is None:
            tol = settings.tol * (0.1 if self.thorough else 1.0)
        if cameras.name != "affine":
            likelihood = MarginalLikelihood(self.frames, self.penalty, EXTENT_WEIGHT)
        if least_noise is None:
            least_noise = settings.options.least_noise
        return refine_joint(
            likelihood,
            state,
            cameras,
            least_noise=least_noise,
            max_iter=settings.max_iter if max_iter is None else max_iter,
            tol=tol,
            on_step=settings.on_step,
        )


def _reversed_back(
    block: FrameTracks, motion: NDArray, search: CalibratedSearch, noise: float
) -> tuple[NDArray, NDArray]:
    """Return the better cameras (n_frames, 2, 3), and the mask of reversed ones."""
    found = [
        search.reversed_cameras(frame_sums(piece, search.shared), noise, motion[frames])
        for frames, piece in block.pieces(BLOCK_FRAMES)
    ]
    cameras, better = map(np.concatenate, zip(*found, strict=True))
    return cameras, better
