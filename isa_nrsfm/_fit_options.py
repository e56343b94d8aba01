"""How a table is fitted: the parameters of a fit, and the limits of its stages."""

from typing import Any, NamedTuple

from numpy.typing import NDArray

from isa_nrsfm._gauge.independent import GaugeOptions
from isa_nrsfm._joint.options import JointOptions
from isa_nrsfm._prepare.options import CompletionOptions, OutlierOptions
from isa_nrsfm._tables.layout import Layout

# Convergence tolerances by default. JOINT_TOL: decrease of the objective of the joint
# refinement for each frame. PAPER_TOL: gain of the paper's refinement, as a share of
# the energy that it explains.
JOINT_TOL, PAPER_TOL = 0.025, 1e-10


class Limits(NamedTuple):
    """
    What steers the decisions of the stages, a tuple for each.

    Attributes
    ----------
    outliers : OutlierOptions
        Of the search for gross outliers.
    completion : CompletionOptions
        Of missing points.
    dense : int
        A table with more points and more rows of images than this is not factorised as
        a whole.
    sample : int
        Number of frames of the first sample of a large table.
    small_table : int
        Tables with fewer coordinates than this are fitted without a sample.
    joint : JointOptions
        Of the joint refinement.
    gauge : GaugeOptions
        Of the gauge after it.
    start_steps, start_tol : int and float
        Largest number of steps, and tolerance, of the paper's refinement before a joint
        one.
    most_components : int
        Largest number of basis shapes that ``n_components="auto"`` tries.
    n_starts : int
        Number of starts of the fit of a frame besides zero: coefficients of other
        frames.
    """

    outliers: OutlierOptions = OutlierOptions()
    completion: CompletionOptions = CompletionOptions()
    dense: int = 1500
    sample: int = 600
    small_table: int = 150_000
    joint: JointOptions = JointOptions()
    gauge: GaugeOptions = GaugeOptions()
    start_steps: int = 200
    start_tol: float = 1e-5
    most_components: int = 12
    n_starts: int = 8


class FitOptions(NamedTuple):
    """
    How a table is fitted: parameters of `AffineNRSfM`, checked.

    Attributes
    ----------
    isa : object
        The unfitted strategy, with all its parameters set.
    default_isa : bool
        Whether the strategy is the default one, not given by the user.
    block_recovery, refinement, camera, independence, loss, layout, max_iter, tol
        As of `AffineNRSfM`.
    scale_frames : bool
        Whether each frame gets size one. Orthographic cameras never scale frames.
    names : ndarray of shape (2 * n_points,) or None
        Names of the columns.
    limits : Limits
        What steers the stages.
    """

    isa: Any
    default_isa: bool
    block_recovery: str
    refinement: str | None
    camera: str
    independence: str | None
    loss: str
    layout: Layout
    scale_frames: bool
    max_iter: int
    tol: float | None
    names: NDArray | None
    limits: Limits

    @property
    def joint(self) -> bool:
        """Whether the refinement is the joint one."""
        return self.refinement == "joint"

    @property
    def joint_tol(self) -> float:
        """Tolerance of the joint refinement."""
        return JOINT_TOL if self.tol is None else self.tol
