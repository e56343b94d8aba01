"""The limits that steer the joint fit, a tuple for each of its stages."""

from typing import NamedTuple


class SearchOptions(NamedTuple):
    """
    How the quasi-Newton steps of `refine_joint` go on.

    ``python -m benchmarks.sensitivity joint.search`` shows half and twice of each.

    Attributes
    ----------
    memory : int
        L-BFGS memory: number of pairs (step, change of the gradient) that are kept.
    memory_numbers : int
        Fewer pairs are kept if all would exceed so many numbers.
    least_memory : int
        But never fewer than so many.
    noise_floor : float
        Lower bound of the noise variance, as a share of the mean square of the tracks.
        It keeps the objective finite for tables without noise.
    largest_noise_step : float
        The logarithm of the noise variance changes by at most so much in a step.
    sufficient_decrease : float
        Armijo condition: the share of the decrease that the slope predicts.
    shortest_step : float
        Least step length of the line search, as a share of the whole step. A shorter
        step changes the objective by rounding errors only.
    strongest_cut, weakest_cut : float
        Bounds of the factor by which the line search shortens a step.
    least_curvature : float
        A pair is kept if the cosine between its step and change is larger.
    """

    memory: int = 20
    memory_numbers: int = 2**25
    least_memory: int = 3
    noise_floor: float = 1e-11
    largest_noise_step: float = 1.5
    sufficient_decrease: float = 1e-4
    shortest_step: float = 1e-8
    strongest_cut: float = 0.1
    weakest_cut: float = 0.5
    least_curvature: float = 1e-10


class StartOptions(NamedTuple):
    """
    How the starts with calibrated cameras are found and compared.

    ``python -m benchmarks.sensitivity joint.starts`` halves and doubles each. With all
    `widths` doubled the error of yoga rises from 10.6 to 16.8 percent, with all halved
    to 12.5. No other field changes an error by more than 2 percent of it, but for
    `compared_tol`: half of it gains 8 percent on large tables.

    Attributes
    ----------
    widths : tuple of int
        Columns of the mixtures: three for the rigid object and as many for each basis
        shape.
    mixing_steps : int
        Largest number of Levenberg-Marquardt steps of each mixture.
    held_steps : int
        Largest number of steps of every start with its cameras held.
    freed_steps : int
        Largest number of steps of the best starts with their cameras freed.
    compared_tol : float
        Convergence tolerance of these steps, for each frame. It may be large: the
        objectives of starts that lead to different minima differ by tens for each
        frame.
    first_noise : float
        Share of what the mean shape leaves that counts as noise at the start.
    catching_up : int
        Steps after which a further start, of those that are given, is judged by
        whether it can still become the best. With half as many the better one is often
        dropped (``python -m benchmarks.choice``).
    """

    widths: tuple[int, ...] = (6, 9, 12, 18, 24, 36)
    mixing_steps: int = 20
    held_steps: int = 6
    freed_steps: int = 30
    compared_tol: float = 0.5
    first_noise: float = 0.1
    catching_up: int = 10


class Effort(NamedTuple):
    """
    How much a fit compares.

    ``python -m benchmarks.sensitivity joint.small``: half or twice of a field changes
    errors of small tables by at most 2 percent. `polish` costs or saves a tenth of the
    time; turning frames back more than twice (`reversals`) changes nothing there.

    Attributes
    ----------
    n_compared : int
        Frames on which starts are compared.
    n_finalists : int
        Starts that are fitted. If there are several, all starts go on with cameras
        that move before the best are chosen.
    polish : float
        Convergence tolerance, as a share of the user's.
    reversals : int
        Largest number of rounds in which frames that are reversed in depth are turned
        back.
    race_steps : int or None
        Steps of the two affine fits of which the better one goes on; None for both.
    """

    n_compared: int
    n_finalists: int
    polish: float
    reversals: int
    race_steps: int | None


class JudgementOptions(NamedTuple):
    """
    When a model is right, and how it is fitted then or otherwise.

    ``python -m benchmarks.sensitivity joint.judgement`` shows half and twice of each.

    Attributes
    ----------
    right : float
        A model is right if its noise variance is at most so many times that of the
        spectrum. The ratio is 0.8 to 1.0 for artificial tables with the true K or more,
        and 1.3 to 1.8 with fewer basis shapes. It is 1.9 and more for motion capture
        and cloth, where K cuts a full spectrum off (``python -m benchmarks.accuracy
        noise``).
    exact : float
        A model is also right if its noise variance is below this share of the mean
        square, as in tables without noise: the spectrum tells no noise if it has only
        3K + 3 singular values.
    slack : float
        A noise variance is at the floor if it exceeds it by less than this share.
    released_steps : int
        Without floor and prior the fit makes so many steps at a time,
    falling : float
        as long as they lower the noise variance to less than this share of its value.
    polish : float
        Convergence tolerance of a right model, as a share of the user's, if no sample
        is taken.
    cut_off : float
        Floor of the noise variance for a model with too few basis shapes and calibrated
        cameras, in shares of the energy beyond K + 3 singular values (``python -m
        benchmarks.accuracy noise``),
    most_noise : float
        but at most this share of the mean square. Without that bound the floor would be
        too high for large motion, which adds to the spectrum, too.
    """

    right: float = 1.4
    exact: float = 1e-10
    slack: float = 1e-3
    released_steps: int = 60
    falling: float = 0.95
    polish: float = 0.1**2
    cut_off: float = 3.0
    most_noise: float = 5e-4


class ManyPointOptions(NamedTuple):
    """
    When frames are given by directions.

    ``python -m benchmarks.sensitivity joint.many_points`` shows half and twice of each.

    Attributes
    ----------
    least_points : int
        Frames are given by directions if they have more points than this,
    wide : float
        and more than so many times the number of rows of all shapes.
    widenings : int
        Largest number of times that directions are added.
    """

    least_points: int = 200
    wide: float = 8
    widenings: int = 20


class ReweightingOptions(NamedTuple):
    """
    When the weights of a robust loss are settled.

    ``python -m benchmarks.sensitivity joint.reweighting`` shows half and twice of each.

    Attributes
    ----------
    rounds : int
        Largest number of rounds of reweighting.
    settled : float
        Convergence tolerance: no weight changes by more.
    model_frames, fewest_shown : int
        As of `CompletionOptions`, for the median of the residuals.
    """

    rounds: int = 20
    settled: float = 1e-2
    model_frames: int = 2_000
    fewest_shown: int = 200


class RelevanceOptions(NamedTuple):
    """
    Which basis shapes are relevant.

    ``python -m benchmarks.sensitivity joint.relevance`` shows half and twice of each.

    Attributes
    ----------
    rounds : int
        Estimates of the variances of the basis shapes.
    steps : int
        Largest number of steps of the fit of each round.
    determined : float
        Least share of the numbers of a basis shape that the table has to determine. On
        artificial tables with 2 % noise true shapes have 0.998 and more, others 0.83
        and less (``python -m benchmarks.recovery components``).
    smallest : float
        Lower bound of these shares, and of the variances relative to the largest.
    """

    rounds: int = 3
    steps: int = 30
    determined: float = 0.95
    smallest: float = 1e-9


class JointOptions(NamedTuple):
    """
    What steers the joint fit.

    ``python -m benchmarks.sensitivity joint`` halves and doubles each number.
    `basis_std` matters most: a prior twice as wide raises the errors of motion capture
    by a sixth, half of it lowers them as much and raises that of large tables by a
    twelfth. Tables of 2600 frames gain a fifth if they count as small (`few_frames`).

    Attributes
    ----------
    basis_std : float
        Prior of the basis shapes: standard deviation of the coordinates of the image of
        a basis shape whose coefficient is one, as a share of the size of the frame
        (``python -m benchmarks.accuracy prior``).
    least_noise : float
        Floor of the noise variance while the model may be wrong, as a share of the mean
        square of the tracks. Deformation that K basis shapes do not span is not noise:
        with less noise the fit would explain it by wrong depths (``python -m
        benchmarks.accuracy prior``).
    by_chance : float
        Convergence tolerance on a sample, if it is larger than the user's. Each number
        that is fitted lowers the objective by about one by chance. Steps on a sample
        end when they gain less than this share of that, for all numbers of the shapes
        together.
    compared_steps : int
        Largest number of steps of an affine fit that is only compared with the
        calibrated one.
    few_frames : int
        Largest number of frames of a small table.
    small, large : Effort
        For small tables, and for large ones and samples. Small tables, such as motion
        capture, have several minima, and comparing them costs little. Large tables show
        many people or things: all starts find the same minimum.
    starts, judgement, search, many_points, reweighting, relevance
        Of the stages.
    """

    basis_std: float = 0.008
    least_noise: float = 5e-5
    by_chance: float = 0.03
    compared_steps: int = 60
    few_frames: int = 2000
    small: Effort = Effort(400, 3, 0.1, 5, None)
    large: Effort = Effort(200, 1, 1.0, 0, 5)
    starts: StartOptions = StartOptions()
    judgement: JudgementOptions = JudgementOptions()
    search: SearchOptions = SearchOptions()
    many_points: ManyPointOptions = ManyPointOptions()
    reweighting: ReweightingOptions = ReweightingOptions()
    relevance: RelevanceOptions = RelevanceOptions()


JOINT_OPTIONS = JointOptions()
