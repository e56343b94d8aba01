"""The joint fit of some frames of a table, with the settings of all its stages."""

from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.calibrated_newton import CalibratedSearch
from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._frames.point_sums import FrameTracks, frame_sums
from isa_nrsfm._frames.posterior import approximate_cameras
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.likelihood import MarginalLikelihood, totals
from isa_nrsfm._joint.quasi_newton import JointResult, JointState, refine_joint

# Standard deviation, as a share of the frame size, of the coordinates of the image of a
# basis shape, one deviation of its coefficient: the prior of the basis shapes.
# (``python -m benchmarks.accuracy prior``)
BASIS_STD = 0.008
# The noise variance is at least this share of the mean square: what K basis shapes
# leave of the object is not noise, and does not tell its depth.
# (``python -m benchmarks.accuracy prior``)
LEAST_NOISE = 5e-5


class Steps(NamedTuple):
    """
    How long the steps of a fit go on.

    Attributes
    ----------
    max_iter : int
        The most steps.
    tol : float
        As of `refine_joint`.
    on_step : callable or None
        As of `refine_joint`.
    to_the_end : bool
        Whether the frames are few and all of the table, so that more steps cost little.
    """

    max_iter: int
    tol: float
    on_step: Callable[[], None] | None = None
    to_the_end: bool = False


class JointProblem:
    """
    The joint fit of some frames.

    Parameters
    ----------
    frames : JointFrames
        The frames.
    steps : Steps
        How long its steps go on.
    penalty : float or ndarray of shape (n_components,)
        As of `MarginalLikelihood`.
    """

    def __init__(
        self,
        frames: JointFrames,
        steps: Steps,
        penalty: NDArray | float,
    ):
        self.frames, self.steps, self.penalty = frames, steps, penalty

    def part(self, chosen: NDArray, **changed: Any) -> Self:
        """Return the problem of some of the frames, with other steps."""
        steps = self.steps._replace(**changed)
        return type(self)(self.frames.take(chosen), steps, self.penalty)

    def with_frames(self, frames: JointFrames) -> Self:
        """Return the problem of the same frames in other coordinates or weights."""
        return type(self)(frames, self.steps, self.penalty)

    def with_penalty(self, penalty: NDArray | float) -> Self:
        """Return the problem with another penalty, or one for each basis shape."""
        problem = type(self)(self.frames, self.steps, penalty)
        problem.totals = self.totals  # a pass over all frames
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
        """Return the means of the coefficients (n_frames, n_components)."""
        return self.likelihood.coefficients(*state)

    def aligned(self, state: JointState, camera: str) -> JointState:
        """Return a state with cameras close to the best for its shapes and noise."""
        shapes = state.shapes
        if self.frames.directions is None:
            shapes = shapes - shapes.mean(axis=2, keepdims=True)
        aligned = partial(
            _aligned_cameras, shapes=shapes, noise=state.noise, camera=camera
        )
        motion = self.frames.blocks.joined(aligned)
        return JointState(shapes, motion.transpose(1, 2, 0), state.noise)

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
            With the cameras that frames reach from reversed ones where the objective is
            lower there.
        n_reversed : int
            The number of these frames.
        """
        function = partial(
            _reversed_back,
            shapes=state.shapes,
            noise=state.noise,
            scaled=cameras.scaled,
        )
        found = self.frames.blocks.map(function, state.motion.transpose(2, 0, 1))
        motion, better = map(np.concatenate, zip(*found, strict=True))
        motion = np.ascontiguousarray(motion.transpose(1, 2, 0))
        return state._replace(motion=motion), int(better.sum())

    def refined(
        self,
        state: JointState,
        cameras: CameraModel,
        least_noise: float,
        **changed: Any,
    ) -> JointResult:
        """
        Return the joint refinement of a state.

        Parameters
        ----------
        state : JointState
            Where to start.
        cameras : CameraModel
            How its cameras may move.
        least_noise : float
            The least noise variance, a share of the mean square.
        **changed : object
            Settings of `Steps` that are different.

        Returns
        -------
        JointResult
            The refinement.
        """
        steps = self.steps._replace(**changed)
        return refine_joint(
            self.likelihood,
            state,
            cameras,
            least_noise=least_noise,
            max_iter=steps.max_iter,
            tol=steps.tol,
            on_step=steps.on_step,
        )


def _reversed_back(
    block: list[FrameTracks],
    motion: NDArray,
    shapes: NDArray,
    noise: float,
    scaled: bool,
) -> tuple[NDArray, NDArray]:
    """Return cameras (n_frames, 2, 3) of a block, and which of them are new."""
    search, parts, first = CalibratedSearch(shapes, scaled), [], 0
    for part in block:
        products = frame_sums(part, search.shapes)
        some = motion[first : first + len(part.weight)]
        parts.append(search.reversed_cameras(products, noise, some))
        first += len(part.weight)
    cameras, better = map(np.concatenate, zip(*parts, strict=True))
    return cameras, better


def _aligned_cameras(
    block: list[FrameTracks], shapes: NDArray, noise: float, camera: str
) -> NDArray:
    """Return cameras (n_frames, 2, 3) close to the best for given shapes."""
    parts = [approximate_cameras(part, shapes, noise, camera=camera) for part in block]
    return np.concatenate(parts)
