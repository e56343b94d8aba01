"""The joint fit as an optimisation problem: frames, penalty and stopping rule."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CAMERAS, CameraModel
from isa_nrsfm._frames.models import frame_search
from isa_nrsfm._frames.newton import CalibratedSearch
from isa_nrsfm._frames.point_sums import FrameTracks, frame_sums
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.likelihood import EXTENT_WEIGHT, MarginalLikelihood
from isa_nrsfm._joint.quasi_newton import JointFit, JointState, refine_joint
from isa_nrsfm._paper.factors import Factorisation
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables.blocks import BLOCK_FRAMES, FrameBlocks


class JointOptions(NamedTuple):
    """Thresholds of the joint fit; docs/benchmarks/README.md has their effects."""

    # Prior standard deviation of the coordinates of the image of a basis shape with
    # coefficient one, as a share of the size of the frame
    basis_std: float = 0.008
    # Floor of the noise variance while K may be too small, as a share of the mean
    # square. Unmodelled deformation must be absorbed by the noise; otherwise it
    # distorts the depths.
    least_noise: float = 5e-5
    # K is sufficient if the noise variance does not exceed this multiple of the noise
    # level of the spectrum. The ratio is 0.8 to 1.0 for artificial tables with the true
    # K or more, 1.3 to 1.8 with fewer basis shapes, 1.9 and more for motion capture.
    right: float = 1.4
    # Floor of the noise variance for calibrated cameras and too few basis shapes: a
    # multiple of the share of energy beyond K + 3 singular values, and its upper bound,
    # because large motion adds to the spectrum
    cut_off: float = 3.0
    most_noise: float = 5e-4
    # Largest number of frames of a small table, with several minima. In large tables
    # all starts lead to the same minimum.
    few_frames: int = 2000
    # Columns of the mixtures from which cameras start, three for each shape
    widths: tuple[int, ...] = (6, 9, 12, 18, 24, 36)
    # Convergence tolerance of compared starts, for each frame. The objectives of
    # different minima differ by tens per frame.
    compared_tol: float = 0.5
    # Frames with more points are represented by directions.
    many_points: int = 200
    # Threshold of a relevant basis shape, the share of its numbers that the table
    # determines. On artificial tables with 2 % noise true shapes have 0.998 and more,
    # others 0.83 and less.
    determined: float = 0.95


JOINT_OPTIONS = JointOptions()


class FactorisedTable(NamedTuple):
    """A table that is ready for a fit.

    completed: its frames (I, 2, J) with missing points and outliers filled in.
    outliers (I, J): points that a robust loss leaves out at first; None for other
    losses.
    singular_values (3 K + 3,): the largest ones of the completed table, decreasing.
    rest: sum of the squares of the other ones.
    W, parts, factors: matrix of a first sample, growing samples (`sample_frames`), and
    factors of the matrix.
    """

    scaled: ScaledTable
    completed: FrameBlocks
    outliers: NDArray | None
    singular_values: NDArray
    rest: float
    W: NDArray
    parts: list[NDArray]
    factors: Factorisation

    @property
    def rest_share(self) -> float:
        """Share of the energy outside of the leading singular values."""
        return float(self.rest / (np.sum(self.singular_values**2) + self.rest))

    def noise_level(self, n_components: int) -> float:
        """Return the noise variance of the spectrum as a share of the mean square.

        The mean of the squared singular values beyond 3K + 3 (Tipping, Bishop,
        "Probabilistic principal component analysis", 1999, eq. 8).
        """
        # Mean energy of the dimensions beyond, over that of all seen - 1 dimensions
        seen = float(np.mean(self.scaled.n_seen))
        n_others = seen - 1 - (3 * n_components + 3)
        noise = self.rest_share * (seen - 1) / n_others if n_others > 0 else 0.0
        # Points that were filled in add to the energy of the table, but have no noise.
        return noise * self.W.shape[1] / seen

    def missing_share(self, n_components: int) -> float:
        """Return the share of the energy beyond the K + 3 largest singular values.

        For motion capture, it is about the share of the shapes outside the best K basis
        shapes.
        """
        squares = self.singular_values**2
        beyond = np.sum(squares[n_components + 3 :]) / (np.sum(squares) or 1.0)
        return float(self.rest_share + (1 - self.rest_share) * beyond)


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
    def cameras(self) -> CameraModel:
        """The camera model of the settings."""
        return CAMERAS[self.settings.camera]

    @property
    def mean_square(self) -> float:
        """Mean square of the visible coordinates."""
        n_seen, energy = self.frames.totals
        return energy / n_seen

    @cached_property
    def likelihood(self) -> MarginalLikelihood:
        """The objective."""
        return MarginalLikelihood(self.frames, self.penalty)

    def aligned(
        self, state: JointState, cameras: CameraModel | None = None
    ) -> JointState:
        """Return a state with nearly optimal cameras for its centred shapes."""
        shapes = state.shapes
        if self.frames.directions is None:
            shapes = shapes - shapes.mean(axis=2, keepdims=True)
        search = frame_search((cameras or self.cameras).name, shapes)
        fitted = partial(search.fit, noise=state.noise, covariances=False, rough=True)
        motion = self.frames.blocks.joined(lambda block: fitted(block).motion)
        return JointState(shapes, motion, state.noise)

    def reversed_back(
        self, state: JointState, cameras: CameraModel
    ) -> tuple[JointState, int]:
        """Return a state without frames that are reversed in depth, and their number.

        The search for each frame is repeated from its camera reversed in depth. The
        result is used if its objective is lower.
        """
        search = CalibratedSearch(state.shapes, cameras.scaled)

        def reversed_cameras(block: FrameTracks, motion: NDArray) -> Any:
            parts = [
                search.reversed_cameras(
                    frame_sums(piece, search.shared), state.noise, motion[frames]
                )
                for frames, piece in block.pieces(BLOCK_FRAMES)
            ]
            return tuple(map(np.concatenate, zip(*parts, strict=True)))

        parts = self.frames.blocks.map(reversed_cameras, state.motion)
        motion, better = map(np.concatenate, zip(*parts, strict=True))
        return state._replace(motion=motion), int(better.sum())

    def refined(
        self,
        state: JointState,
        cameras: CameraModel | None = None,
        least_noise: float | None = None,
        max_iter: int | None = None,
        tol: float | None = None,
    ) -> JointFit:
        """Refine a state jointly, by default with the settings of the problem."""
        settings, likelihood = self.settings, self.likelihood
        cameras = cameras or self.cameras
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
