"""Thresholds of the joint fit."""

from typing import NamedTuple


class JointOptions(NamedTuple):
    """Thresholds of the joint fit.

    ``python -m benchmarks.sensitivity joint`` halves and doubles each number.
    `basis_std` matters most. If it is doubled, the errors of motion capture rise by a
    sixth. If it is halved, they fall by as much, but those of large tables rise by a
    twelfth. The errors of tables of 2600 frames fall by a fifth if these are treated as
    small (`few_frames`). If all `widths` are doubled, the error of yoga rises from 10.6
    to 16.8 percent; if all are halved, to 12.5. Half of `compared_tol` lowers the
    errors of large tables by 8 percent.

    basis_std: prior standard deviation of the coordinates of the image of a basis shape
    with coefficient one, as a share of the size of the frame (``benchmarks.accuracy``).
    least_noise: floor of the noise variance while the model may be wrong, as a share of
    the mean square. Unmodelled deformation must be absorbed by the noise; otherwise it
    distorts the depths. right: largest noise variance of a right model, in units of
    that of the spectrum. The ratio is 0.8 to 1.0 for artificial tables with the true K
    or more, 1.3 to 1.8 with fewer basis shapes, 1.9 and more for motion capture
    (``benchmarks.accuracy noise``). cut_off, most_noise: floor of the noise variance
    for calibrated cameras and too few basis shapes. It is a multiple of the share of
    energy beyond K + 3 singular values, with an upper bound because large motion adds
    to the spectrum.
    few_frames: largest number of frames of a small table, with several minima. In large
    tables all starts find the same minimum. widths: columns of the mixtures from which
    cameras start, three for each shape. compared_tol: convergence tolerance of compared
    starts, for each frame. The objectives of different minima differ by tens per frame.
    many_points: frames with more
    points are represented by directions. determined: threshold of a relevant basis
    shape, the share of its numbers that the table determines. On artificial tables with
    2 % noise true shapes have 0.998 and more, others 0.83 and less
    (``benchmarks.recovery components``).
    """

    basis_std: float = 0.008
    least_noise: float = 5e-5
    right: float = 1.4
    cut_off: float = 3.0
    most_noise: float = 5e-4
    few_frames: int = 2000
    widths: tuple[int, ...] = (6, 9, 12, 18, 24, 36)
    compared_tol: float = 0.5
    many_points: int = 200
    determined: float = 0.95


JOINT_OPTIONS = JointOptions()
