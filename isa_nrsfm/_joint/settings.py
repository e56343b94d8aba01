"""Settings of a fit: parameters of the estimator, and limits that steer it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._joint.prior import ShapePrior
from isa_nrsfm._parameters import JOINT_REFINEMENTS
from isa_nrsfm._tables import Layout
from isa_nrsfm.isa._pipeline import DENSE

# Default tolerances. JOINT_TOL: decrease of the objective of the joint refinement per
# frame. PAPER_TOL: gain of the paper's refinement, as a share of the explained energy.
JOINT_TOL, PAPER_TOL = 0.025, 1e-10


class Limits(NamedTuple):
    """Numbers that tests and benchmarks vary.

    docs/benchmarks/README.md has the effects of those of the joint fit.
    """

    # A table with more points and rows of images is not factorised as a whole.
    dense: int = DENSE
    # Number of frames of the first sample of a large table
    sample: int = 600
    # Tables with fewer coordinates are fitted without a sample.
    small_table: int = 150_000
    # Most frames from which outliers and missing points are modelled
    model_frames: int = 5_000
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
    # Largest number of steps of a fit that estimates errors of depths. 30 steps
    # understate those of undetermined depths.
    error_steps: int = 100
    # Whether calibrated cameras have further starts: from more or fewer basis shapes,
    # from cameras that turn less, and from groups of frames reversed in depth
    restarts: bool = True


LIMITS = Limits()


class FitSettings(NamedTuple):
    """The parameters of `AffineNRSfM` of the same names, and limits.

    scale_frames: False with orthographic cameras. names: those of the columns, if any.
    prior: the `TableModel` of the estimator, or None; shape_prior: made from it.
    mirror_certainty: that of the prior.
    groups (n_rows,): numbers of the people or videos of the rows, if given.
    silent_isa: whether a strategy that only starts the joint fit may end early.
    on_step: called before each step of the joint fit.
    whole: whether fits of calibrated cameras have all directions of a shape.
    free: whether K is the number of directions that the table determines, or with
    affine cameras falls until all directions of the coefficients are reliable.
    errors: whether to estimate the errors of the depths.

    Of a fit that continues another one, a `TableModel` of a similar table as its start:
    placed: frames of the table in that model. known: results that both fits have, by
    name; those that are lacking are added.
    """

    refinement: str | None = "joint"
    camera: str = "affine"
    loss: str = "linear"
    independence: str | None = "shapes"
    block_recovery: str = "generalized_eigen"
    layout: Layout = "interleaved"
    scale_frames: bool = True
    hidden_points: bool = True
    max_iter: int = 1000
    tol: float = JOINT_TOL
    n_jobs: int | None = None
    names: NDArray | None = None
    prior: Any = None
    mirror_certainty: float = np.nan
    shape_prior: ShapePrior | None = None
    silent_isa: bool = True
    limits: Limits = LIMITS
    on_step: Callable[[], None] | None = None
    whole: bool = True
    groups: NDArray | None = None
    remove_pose: bool = False
    free: bool = False
    errors: bool = True
    start: Any = None
    placed: Any = None
    known: dict[str, Any] | None = None

    @property
    def all_directions(self) -> bool:
        """Whether the joint fit has all directions of a shape, whatever K is."""
        calibrated = self.joint and self.camera != "affine"
        return calibrated and self.whole and self.prior is None

    @property
    def joint(self) -> bool:
        """Whether the refinement is the joint fit, or begins with it."""
        return self.refinement in JOINT_REFINEMENTS
