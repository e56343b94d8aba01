"""The limits that steer the fit of single frames."""

from typing import NamedTuple


class Damping(NamedTuple):
    """
    How the steps of `descend` are damped, frame by frame.

    The damping is relative to a positive definite part of the Hessian. At first there
    is none.

    Attributes
    ----------
    first : float
        The least damping after a step that is refused.
    raised : float
        Its factor then.
    eased : float
        Its factor after a good step.
    least : float
        No damping is left after a good step with this or less.
    largest : float
        With so much a step no longer moves, and the search of the frame ends.
    """

    first: float
    raised: float
    eased: float
    least: float
    largest: float = 1e8


class FrameOptions(NamedTuple):
    """
    What steers the fit of frames to given shapes.

    ``python -m benchmarks.frame_search`` halves and doubles each value. No frame of its
    tables then ends in another minimum. `suspicious` and `promised` only cost time, and
    `settled` is the error of robust fits. Half as many `rough_steps` leave cameras of
    motion capture with errors of 19 % instead of 8 %. With 3, 6 and 12 `reversed_steps`
    22, 7 and 1 % of its reversed cameras are left as they are.

    Attributes
    ----------
    max_steps : int
        Largest number of steps of a search.
    first_steps : int
        Largest number of steps of the first round of affine frames, block by block.
        Those that have not converged then are collected from all blocks.
    rough_steps : int
        Largest number of steps for rough calibrated cameras.
    reversed_steps : int
        Largest number of steps from calibrated cameras and from the reversed ones,
        where these are compared in a fit of many frames.
    tolerance : float
        Convergence tolerance: a frame has converged when a step without damping gains
        less than this share of its energy. Convergence is quadratic: the next step
        would gain far less.
    equal : float
        Objectives that differ by less than this share are equal.
    promised : float
        A search with a limit is given up when the objective has to fall by more than
        so many times the predicted gain of the next step.
    suspicious : float
        An objective above this multiple of its expectation may be a local minimum only:
        further starts are tried.
    largest_turn : float
        Largest rotation of a camera in one step, in radians, and largest change of the
        logarithm of its scale.
    saddle : float
        The least damping of affine frames whose Hessian is not positive definite.
    affine, calibrated : Damping
        Damping of the two searches.
    reweightings : int
        Largest number of rounds of a robust fit.
    settled : float
        Convergence tolerance of its weights.
    complete_block, weighted_block : int
        Frames in a block, without and with weights: enough to be worth the calls, few
        enough for the cache. Frames with weights have a Gram matrix each.
    """

    max_steps: int = 60
    first_steps: int = 5
    rough_steps: int = 3
    reversed_steps: int = 6
    tolerance: float = 1e-12
    equal: float = 1e-10
    promised: float = 10.0
    suspicious: float = 3.0
    largest_turn: float = 1.0
    saddle: float = 0.05
    affine: Damping = Damping(first=0.5, raised=4.0, eased=0.125, least=0.05)
    calibrated: Damping = Damping(first=0.1, raised=8.0, eased=0.1, least=0.01)
    reweightings: int = 50
    settled: float = 1e-4
    complete_block: int = 2048
    weighted_block: int = 1024


FRAME_OPTIONS = FrameOptions()
