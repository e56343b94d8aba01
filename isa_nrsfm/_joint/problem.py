"""The joint fit as a problem: frames, penalty, and how long to iterate."""

from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.calibrated_newton import CalibratedSearch
from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._frames.point_sums import FrameTracks, frame_sums
from isa_nrsfm._frames.posterior import fit_frames, frame_search
from isa_nrsfm._joint.extents import EXTENT_WEIGHT
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.likelihood import BLOCK_FRAMES, MarginalLikelihood, totals
from isa_nrsfm._joint.options import JOINT_OPTIONS, Effort, JointOptions
from isa_nrsfm._joint.quasi_newton import JointResult, JointState, refine_joint


class Steps(NamedTuple):
    """
    When the iteration of a fit ends.

    Attributes
    ----------
    max_iter : int
        Largest number of steps.
    tol : float
        Convergence tolerance, as of `refine_joint`.
    on_step : callable or None
        As of `refine_joint`.
    effort : Effort
        How much the fit compares.
    """

    max_iter: int
    tol: float
    on_step: Callable[[], None] | None = None
    effort: Effort = JOINT_OPTIONS.large


class JointProblem:
    """
    The objective of the joint fit of some frames, and the steps that minimise it.

    Parameters
    ----------
    frames : JointFrames
        The frames.
    steps : Steps
        When its iteration ends.
    penalty : float or ndarray of shape (n_components,)
        As of `MarginalLikelihood`.
    options : JointOptions
        The limits of all stages.
    """

    def __init__(
        self,
        frames: JointFrames,
        steps: Steps,
        penalty: NDArray | float,
        options: JointOptions = JOINT_OPTIONS,
    ):
        self.frames, self.steps, self.penalty = frames, steps, penalty
        self.options = options

    def part(self, chosen: NDArray, **changed: Any) -> Self:
        """Return the problem of some of the frames, with some fields of `Steps` set."""
        steps = self.steps._replace(**changed)
        return type(self)(self.frames.take(chosen), steps, self.penalty, self.options)

    def with_frames(self, frames: JointFrames) -> Self:
        """Return the problem of the same frames in other coordinates or weights."""
        return type(self)(frames, self.steps, self.penalty, self.options)

    def with_penalty(self, penalty: NDArray | float) -> Self:
        """Return the problem with another penalty, or one for each basis shape."""
        problem = type(self)(self.frames, self.steps, penalty, self.options)
        problem.totals = self.totals  # saves a pass over all frames
        return problem

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.frames.n_frames

    @cached_property
    def totals(self) -> tuple[float, float]:
        """Number of coordinates that the frames show, and their energy."""
        return totals(self.frames.blocks)

    @cached_property
    def likelihood(self) -> MarginalLikelihood:
        """The objective."""
        return MarginalLikelihood(self.frames.blocks, self.penalty, self.totals)

    def coefficients(self, state: JointState) -> NDArray:
        """Return the posterior means of the coefficients (n_frames, n_components)."""
        return self.likelihood.coefficients(*state)

    def aligned(self, state: JointState, camera: str) -> JointState:
        """
        Return a state with approximately optimal cameras for its shapes and noise.

        The shapes are centred. The cameras come from a few steps of the search for each
        frame, not from the state.
        """
        shapes = state.shapes
        if self.frames.directions is None:
            shapes = shapes - shapes.mean(axis=2, keepdims=True)
        aligned = partial(
            _aligned_cameras, shapes=shapes, noise=state.noise, camera=camera
        )
        return JointState(shapes, self.frames.blocks.joined(aligned), state.noise)

    def reversed_back(
        self, state: JointState, cameras: CameraModel
    ) -> tuple[JointState, int]:
        """
        Return a state without frames that are reversed in depth, and how many were.

        Parameters
        ----------
        state : JointState
            Shapes and calibrated cameras.
        cameras : CameraModel
            Their model.

        Returns
        -------
        state : JointState
            The search for each frame is repeated from its camera reversed in depth. The
            camera that it finds is taken where the objective is lower.
        n_reversed : int
            The number of these frames.
        """
        function = partial(
            _reversed_back,
            shapes=state.shapes,
            noise=state.noise,
            scaled=cameras.scaled,
        )
        found = self.frames.blocks.map(function, state.motion)
        motion, better = map(np.concatenate, zip(*found, strict=True))
        return state._replace(motion=motion), int(better.sum())

    def refined(
        self,
        state: JointState,
        cameras: CameraModel,
        least_noise: float | None = None,
        **changed: Any,
    ) -> JointResult:
        """
        Return the joint refinement of a state.

        Parameters
        ----------
        state : JointState
            The first iterate.
        cameras : CameraModel
            The cameras that are allowed.
        least_noise : float, optional
            Lower bound of the noise variance, as a share of the mean square. By default
            that of a model that may be wrong.
        **changed : object
            Settings of `Steps` that are different.

        Returns
        -------
        JointResult
            The refinement.
        """
        steps = self.steps._replace(**changed)
        likelihood = self.likelihood
        if cameras.name != "affine":
            likelihood = MarginalLikelihood(
                self.frames.blocks, self.penalty, self.totals, EXTENT_WEIGHT
            )
        return refine_joint(
            likelihood,
            state,
            cameras,
            least_noise=(
                self.options.least_noise if least_noise is None else least_noise
            ),
            max_iter=steps.max_iter,
            tol=steps.tol,
            on_step=steps.on_step,
            options=self.options,
        )


def _reversed_back(
    block: FrameTracks,
    motion: NDArray,
    shapes: NDArray,
    noise: float,
    scaled: bool,
) -> tuple[NDArray, NDArray]:
    """Return the better cameras (n_frames, 2, 3), and which ones were reversed."""
    search = CalibratedSearch(shapes, scaled)
    found = [
        search.reversed_cameras(frame_sums(piece, search.shared), noise, motion[frames])
        for frames, piece in block.pieces(BLOCK_FRAMES)
    ]
    cameras, better = map(np.concatenate, zip(*found, strict=True))
    return cameras, better


def _aligned_cameras(
    block: FrameTracks, shapes: NDArray, noise: float, camera: str
) -> NDArray:
    """Return nearly optimal cameras (n_frames, 2, 3) for shapes (n_shapes, 3, n)."""
    search = frame_search(camera, shapes)
    return fit_frames(block, search, noise, covariances=False, rough=True).motion
