"""The limits that steer how a table is made ready."""

from typing import NamedTuple


class CompletionOptions(NamedTuple):
    """
    How missing points are filled in.

    ``python -m benchmarks.sensitivity completion`` shows half and twice of each.

    Attributes
    ----------
    tol : float
        Convergence tolerance: EM ends when a step lowers the noise variance by less
        than this share. Further steps fit the noise more than they improve the missing
        points.
    max_iter : int
        Largest number of steps at the final rank.
    steps_while_growing : int
        EM steps at each rank below the final one. They only make a start for the next
        rank.
    least_weight : float
        Least variance along a new direction of B, relative to the largest. EM cannot
        move a direction of zero variance.
    exact : float
        Below this mean square residual the table has no noise: the fit is exact.
    least_freedom : float
        Least number of degrees of freedom left to the noise, relative to the numbers
        seen.
    block_numbers : int
        Numbers in the largest array of a block of frames. It limits memory.
    model_frames : int
        With more frames than this the model is found from that many of them.
    fewest_shown : int
        Frames are added for each point that fewer of these show.
    model_points : int
        With more points than this the model is first found from that many of them, and
        in all points from fewer frames, for as many numbers.
    """

    tol: float = 0.05
    max_iter: int = 200
    steps_while_growing: int = 10
    least_weight: float = 1e-3
    exact: float = 1e-20
    least_freedom: float = 0.02
    block_numbers: int = 2**20
    model_frames: int = 10_000
    fewest_shown: int = 200
    model_points: int = 300


class OutlierOptions(NamedTuple):
    """
    Which points are gross outliers.

    ``python -m benchmarks.sensitivity outliers`` shows half and twice of each.

    Attributes
    ----------
    distant : float
        A point farther from the spatial median of its frame than this many sizes of the
        frame does not belong to it.
    gross : float
        A gross outlier is farther than this many typical distances from the rigid
        object.
    rounds : int
        The most rounds of the search for gross outliers.
    settled : float
        Its convergence tolerance: the largest change of a filled-in coordinate over the
        typical distance.
    largest_share : float
        If a larger share of a frame's points are gross outliers, the frame is unusual,
        and none of its points is marked.
    model_frames, fewest_shown : int
        As of `CompletionOptions`.
    """

    distant: float = 6.0
    gross: float = 4.5
    rounds: int = 100
    settled: float = 1e-2
    largest_share: float = 0.4
    model_frames: int = 10_000
    fewest_shown: int = 200


class LayoutOptions(NamedTuple):
    """
    When the layout of a table looks wrong.

    Attributes
    ----------
    clearly_better : float
        Warn if the energy that the other layout leaves unexplained is less than this
        share of what the given one leaves. On real tables the right layout leaves 0.04
        to 0.5.
    frames : int
        The layouts are compared on so many frames, evenly spread,
    numbers : int
        or fewer of many points, this over the number of columns,
    fewest_frames : int
        but at least so many.
    fewest_to_tell : int
        With fewer frames or points than this the layouts are not compared.
    """

    clearly_better: float = 0.6
    frames: int = 1000
    numbers: int = 2_000_000
    fewest_frames: int = 100
    fewest_to_tell: int = 10


COMPLETION_OPTIONS, OUTLIER_OPTIONS, LAYOUT_OPTIONS = (
    CompletionOptions(),
    OutlierOptions(),
    LayoutOptions(),
)
