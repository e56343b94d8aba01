"""The limits that steer factorisation, sample and the paper's pipeline."""

from typing import NamedTuple


class SvdOptions(NamedTuple):
    """
    How the leading singular triplets are found.

    ``python -m benchmarks.sensitivity svd`` shows half and twice of each.

    Attributes
    ----------
    dense : int
        A matrix with more rows and more columns than this is not factorised as a whole.
        Its leading subspace is found by a block Krylov method.
    oversampling : int
        Columns of a block of that method, beyond those that are wanted.
    most_passes : int
        Its most passes over the matrix.
    converged : float
        Its convergence tolerance. It ends when the next pass would raise the energy
        found by less than this share of the energy that is left.
    stacked : int
        Triangular factors are stacked up to this many times their width, then
        factorised.
    """

    dense: int = 1500
    oversampling: int = 10
    most_passes: int = 12
    converged: float = 1e-6
    stacked: int = 6


class SampleOptions(NamedTuple):
    """
    On which frames of a large table the first stages work.

    ``python -m benchmarks.sensitivity sample`` shows half and twice of each.

    Attributes
    ----------
    first : int
        Frames of the first sample.
    growth : int
        Each further sample is so many times larger,
    most : int
        up to about so many frames. The last steps take all frames.
    small_table : int
        Tables with fewer coordinates than this are taken whole.
    """

    first: int = 600
    growth: int = 4
    most: int = 40_000
    small_table: int = 150_000


class PaperOptions(NamedTuple):
    """
    What steers the paper's pipeline.

    ``python -m benchmarks.sensitivity paper`` shows half and twice of each.

    Attributes
    ----------
    signal_decimals : int
        The signals are rounded to this many decimals, and their samples sorted, before
        the analysis. Fixed-point iterations from random starts magnify rounding errors,
        so that another order of frames or points could lead to another optimum. Signals
        have unit variance: this is far coarser than rounding errors, and far finer than
        their errors.
    n_lifted_starts : int
        Number of eigenvectors of `leading_blocks` that the refinement starts from.
    lift_ridge : float
        Ridge in `lifted_moments`, relative to the energy of the camera.
    n_trial_steps : int
        Alternations from each start. Only the best one is then iterated to convergence.
    largest_gain : float
        Along any direction a Newton step is at most this many times the alternation
        step.
    """

    signal_decimals: int = 5
    n_lifted_starts: int = 2
    lift_ridge: float = 0.1
    n_trial_steps: int = 6
    largest_gain: float = 1e4


SVD_OPTIONS, SAMPLE_OPTIONS, PAPER_OPTIONS = (
    SvdOptions(),
    SampleOptions(),
    PaperOptions(),
)
