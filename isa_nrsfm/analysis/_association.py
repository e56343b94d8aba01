"""Association of coefficients with a label: a class or a number for each frame.

Labels may be permuted only between units that are exchangeable under the null
hypothesis of no association (Winkler, Webster, Vidaurre, Nichols, Smith, "Multi-level
block permutation", 2015). The means of labels over groups are permuted among the
groups. Within many groups, what each adds to the covariance with the labels gets a
random sign. That allows for any dependence of its frames, such as on sessions. Within
few groups independent frames are permuted. If neighbouring frames of a video
depend on each other, the frequencies of the coefficients are independent instead: the
cosine transform nearly diagonalises the covariance of any stationary series, and of
random walks.

The statistics of independent units are studentised: permutations then keep the level
for classes with other variances (Janssen, "Studentized permutation tests for non-i.i.d.
hypotheses and the generalized Behrens-Fisher problem", 1997; Chung, Romano, "Exact and
asymptotically robust permutation tests", 2013; DiCiccio, Romano, "Robust permutation
tests for correlation and regression coefficients", 2017).
"""

from collections.abc import Generator, Iterable
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from scipy.sparse import csr_array, hstack
from scipy.sparse.linalg import lsmr
from scipy.spatial import cKDTree
from scipy.special import softmax
from scipy.stats import multivariate_normal, norm, rankdata
from sklearn import model_selection
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils import check_array, check_random_state, check_scalar

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.texts import aligned
from isa_nrsfm._linalg import OF_DIFFERENCES
from isa_nrsfm.analysis import _frame_columns
from isa_nrsfm.analysis._frame_columns import TEXTS, unit_columns

# Within so many groups, signs of groups are drawn: 128 different results.
MANY_GROUPS = 8
# Number of the nearest frames whose labels are compared, and level of this test.
NEAREST, REPEATED_LEVEL = 3, 0.01


class FrameOrder:
    """Frames sorted by group (n_frames,), and by time (n_frames,) within each group.

    rows, groups (n_frames,): numbers of the frames in this order, and of their groups.
    sizes, first (n_groups,): number of frames of each group, and place of its first.
    """

    def __init__(self, groups: NDArray, time: NDArray):
        numbers = np.unique(groups, return_inverse=True)[1]
        self.rows = np.lexsort((time, numbers))
        self.groups, self.sizes = numbers[self.rows], np.bincount(numbers)
        self.first = np.cumsum(self.sizes) - self.sizes

    def spectrum(self, values: NDArray, inverse: bool = False) -> NDArray:
        """Transform ordered values (n_frames, k) of each group to cosines, or back."""
        transform = idct if inverse else dct
        parts = np.split(values, self.first[1:])
        return np.concatenate([transform(a, axis=0, norm="ortho") for a in parts])

    def blocks(self, length: int) -> NDArray:
        """Number the blocks of `length` ordered frames within groups (n_frames,)."""
        place = np.arange(len(self.rows)) - self.first[self.groups]
        n_blocks = -(-self.sizes // length)
        first = np.cumsum(n_blocks) - n_blocks
        return np.asarray(place // length + first[self.groups])


def unexplained(alpha: NDArray, labels: csr_array, order: FrameOrder) -> NDArray:
    """Return the part of ordered alpha that neither labels nor groups explain."""
    # Neighbours of one class are alike because of the class: measure the residuals.
    design = hstack([labels, indicators(order.groups)], format="csr")
    return np.stack([a - design @ lsmr(design, a)[0] for a in alpha.T], axis=1)


def independent_length(rest: NDArray) -> int:
    """Return the length of blocks of ordered frames that are independent.

    One if neighbours are uncorrelated: frames, and means of 2, 4, 8, ..., which show
    slow drifts that single frames hide. Otherwise five times the length of the shortest
    means that are.
    """
    length, n_scales = 1, len(rest).bit_length() - 3  # each of eight values or more
    for scale in range(1, n_scales + 1):
        threshold = norm.isf(0.05 / (rest.shape[1] * n_scales))
        r = np.sum(rest[1:] * rest[:-1], axis=0) * np.sqrt(len(rest))
        if np.any(r > threshold * np.sum(rest**2, axis=0)):
            length = 5 * 2**scale
        rest = rest[: len(rest) // 2 * 2].reshape(-1, 2, rest.shape[1]).mean(axis=1)
        rest = rest - rest.mean(axis=0)
    return length


def seams(alpha: NDArray) -> NDArray:
    """Return the frames (n,) before which coefficients jump, as where clips are joined.

    A jump is larger than any of so many normally distributed steps, and, unlike a
    movement, twice as large as the steps before and after it.
    """
    steps = np.abs(np.diff(alpha, axis=0))
    scale = np.median(steps, axis=0) / norm.isf(0.25)
    steps = steps / np.where(scale > 0, scale, np.inf)
    size = np.pad(np.linalg.norm(steps, axis=1), 1)
    apart = size[1:-1] > 2 * np.maximum(size[:-2], size[2:])
    large = np.any(steps > norm.isf(0.025 / steps.size), axis=1)
    return np.flatnonzero(apart & large) + 1


def permuted_energies(
    values: NDArray,
    alpha: NDArray,
    labels: csr_array,
    order: FrameOrder,
    n_permutations: int,
    rng: np.random.RandomState,
) -> tuple[list[NDArray], list[str], str]:
    """
    Compute squared covariances of coefficients with labels, and with permuted labels.

    Coefficients are given as values, and as ranks or values of norm one (alpha).
    Returns those between and within groups, each (n_permutations + 1, n_components)
    with the given labels first; the permuted units; and why they are no test, or "".
    """
    alpha, labels = alpha[order.rows], labels[order.rows]
    sizes, by_group = order.sizes[:, None], indicators(order.groups).T
    means, n_groups = by_group @ alpha / sizes, len(sizes)
    # Sparse: there may be as many classes as groups.
    of_labels = (by_group @ labels).multiply(1.0 / sizes).tocsr()
    square = np.sum(labels.data**2)
    total = square - len(alpha) * np.sum((sizes.T @ of_labels / len(alpha)) ** 2)
    energies, permuted, untested = [], [], ""
    inside = square - np.sum(sizes.T @ of_labels.power(2)) > OF_DIFFERENCES * total
    weights = _weights(labels, of_labels, order)
    between = of_labels.multiply(weights).tocsr()
    # Less the mean of the labels: a part along the weights, and one along ones
    along = weights / np.sqrt(np.sum(weights**2))
    part = along.T @ between
    mean = between.sum(axis=0) - np.sum(along) * part
    energy = np.sum(between.data**2) - np.sum(part**2) - np.sum(mean**2) / n_groups
    if energy > OF_DIFFERENCES * total:
        centres = _standard(means, weights)
        shuffled = (centres[rng.permutation(n_groups)] for _ in range(n_permutations))
        if inside:
            energies.append(_energies(centres, between, shuffled, along))
        else:
            energies.append(_studentised(centres, _unit(of_labels), shuffled))
        permuted.append("groups")
    if not inside:
        return energies, permuted, untested
    alpha = alpha - means[order.groups]
    residuals = unexplained(alpha, labels, order)
    length = independent_length(residuals)
    runs = _runs(labels, order) if n_groups > 1 else None
    varying = np.sum((by_group @ labels.power(2)) - sizes * of_labels.power(2), axis=1)
    many = np.sum(varying > OF_DIFFERENCES) >= MANY_GROUPS
    if many and (length > 1 or runs is not None):
        signs = rng.choice([-1.0, 1.0], (n_permutations + 1, n_groups))
        signs[0] = 1.0
        energies.append(_signed(alpha, labels, by_group, signs))
        return energies, [*permuted, "signs of groups within them"], untested
    units, one_event = f"blocks of {length} frames", 8 * length > len(alpha)
    # Blocks of frames, permuted within groups
    block = order.blocks(length) if runs is None or length > 1 else runs
    draws = (rng.random_sample(block[-1] + 1) for _ in range(n_permutations))
    shuffled = (alpha[np.lexsort((draw[block], order.groups))] for draw in draws)
    if length == 1:
        units = "frames" if runs is None else "runs of a label"
    elif not _are_sorted(labels, order):
        units, shuffled = "frequencies", _waves(alpha, order, n_permutations, rng)
        one_event = _one_event(alpha, labels, order)
    if length > 1 and not permuted:
        untested = TEXTS["untested"]["one_event"] * one_event
    if n_groups == 1:
        cuts = np.intersect1d(seams(values[order.rows]), seams(residuals))
        if length > 1 and len(cuts):
            untested = TEXTS["untested"]["jumps"].format(len(cuts), cuts[0])
        elif length == 1 and _people_repeat(alpha, labels):
            untested = TEXTS["untested"]["repeated"]
    if not untested:
        statistic = _studentised if length == 1 else _energies
        energies.append(statistic(alpha, labels, shuffled))
    permuted.append(f"{units} within groups" if n_groups > 1 else units)
    return energies, permuted, untested


def indicators(numbers: NDArray) -> csr_array:
    """Return columns (n, n_numbers) with one where a row has the number."""
    rows = np.arange(len(numbers))
    return csr_array((np.ones(len(numbers)), (rows, numbers)))


def _are_sorted(labels: csr_array, order: FrameOrder) -> bool:
    """Return whether each class is one run of a single group, or numbers only rise."""
    if len(order.sizes) > 1:
        return False
    if labels.shape[1] > 1:
        return bool(np.count_nonzero(np.diff(labels.indices)) < labels.shape[1])
    steps = np.diff(labels.toarray(), axis=0)
    return bool((steps >= 0).all() or (steps <= 0).all())


def _runs(labels: csr_array, order: FrameOrder) -> NDArray | None:
    """Number the runs of equal labels in groups (n_frames,); None if they are chance.

    Frames of a session have one label, and what else the session does to them.
    """
    values = labels.indices if labels.shape[1] > 1 else labels.toarray()[:, 0]
    numbers = np.unique(values, return_inverse=True)[1]
    changes = (np.diff(numbers) != 0) | (np.diff(order.groups) != 0)
    kinds, counts = np.unique([order.groups, numbers], axis=1, return_counts=True)
    expected = np.sum(counts * (counts - 1) / order.sizes[kinds[0]])
    if np.count_nonzero(~changes) - expected <= 2 * np.sqrt(expected):
        return None
    return np.cumsum(np.append(False, changes))


def _one_event(alpha: NDArray, labels: csr_array, order: FrameOrder) -> bool:
    """Return whether labels share less than two frequencies with alpha, in effect.

    The part of a frequency is the product of the powers of both.
    """
    power = np.zeros((len(alpha), 1))
    for c in range(labels.shape[1]):
        power += order.spectrum(labels[:, [c]].toarray()) ** 2
    power[order.first] = 0.0  # means of groups
    products = power * order.spectrum(alpha) ** 2
    shared = np.sum(products / np.maximum(products.sum(axis=0), 1e-300), axis=1)
    return bool(np.sum(shared) ** 2 < 2 * np.sum(shared**2))


def _waves(
    alpha: NDArray, order: FrameOrder, n_permutations: int, rng: np.random.RandomState
) -> Generator[NDArray, None, None]:
    """Yield ordered coefficients whose frequencies have random signs and sizes.

    Random signs alone keep the power of each frequency. But neighbouring frequencies of
    a regular rhythm have signs that depend on each other; with random sizes, too, they
    do not appear as independent (docs/questions.md).
    """
    spectrum = order.spectrum(alpha)
    for _ in range(n_permutations):
        factors = rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), (len(alpha), 1))
        yield order.spectrum(factors * spectrum, inverse=True)


def _weights(labels: csr_array, means: csr_array, order: FrameOrder) -> NDArray:
    """Return weights (n_groups, 1) with which means of labels have equal variances.

    The shares of the variance are those of `isa_nrsfm.analysis.between_share`.
    """
    sizes = order.sizes[:, None]
    if (sizes == sizes[0]).all():
        return np.ones(sizes.shape)
    square, of_means = labels.power(2).sum(axis=0), (sizes.T @ means.power(2))[0]
    total = square - labels.sum(axis=0) ** 2 / len(order.rows)
    within = square - of_means
    share = np.average(between_shares(within, total - within, sizes), weights=total)
    return np.asarray(1.0 / np.sqrt(share + (1.0 - share) / sizes))


def between_shares(within: NDArray, apart: NDArray, sizes: NDArray) -> NDArray:
    """Return shares of variances between groups, from sums of squares."""
    n_frames, n_groups = sizes.sum(), len(sizes)
    # Mean squares of the analysis of variance, and the typical size of a group
    within, apart = within / (n_frames - n_groups), apart / (n_groups - 1)
    size = (n_frames - np.sum(sizes**2) / n_frames) / (n_groups - 1)
    # Variance components
    between = np.maximum(apart - within, 0.0) / size
    total = between + within
    return np.divide(between, total, where=total > 0, out=np.zeros_like(total))


def _standard(means: NDArray, weights: NDArray) -> NDArray:
    """Weight the means of groups (n_groups, k), relative to their mean."""
    centre = np.sum(weights**2 * means, axis=0) / np.sum(weights**2)
    weighted = weights * (means - centre)
    return np.asarray(weighted - weighted.mean(axis=0))


def _energies(
    alpha: NDArray, labels: csr_array, permuted: Iterable[NDArray], without: Any = 0.0
) -> NDArray:
    """Return squared covariances (n_permutations + 1, n_components).

    The part of the labels along a column `without` (n, 1) of norm one does not count.
    """
    energy = np.sum(alpha**2, axis=0)
    rests = (a - without * np.sum(without * a, axis=0) for a in (alpha, *permuted))
    energies = np.array([np.sum((labels.T @ a) ** 2, axis=0) for a in rests])
    return np.asarray(energies / np.where(energy > 0, energy, 1.0))


def _unit(labels: csr_array) -> csr_array:
    """Return indicators, or a centred column, with norm one."""
    if labels.shape[1] == 1:
        return csr_array(unit_columns(labels.toarray()))
    return csr_array(labels / np.sqrt(labels.power(2).sum(axis=0)))


def _studentised(
    alpha: NDArray, labels: csr_array, permuted: Iterable[NDArray]
) -> NDArray:
    """Return statistics (n_permutations + 1, n_components).

    Of indicators of classes, of norm one, that of Welch ("On the comparison of several
    mean values", 1951) without the factor for the degrees of freedom; of a centred
    column x the square of ``sum_i x_i a_i`` over the sum of the squares of its terms.
    Each class has one more frame of the pooled variance.
    """
    squares, n_classes = labels.power(2), labels.shape[1]
    sizes = labels.sum(axis=0)[:, None] ** 2

    def statistic(a: NDArray) -> NDArray:
        means, moments = labels.T @ a, squares.T @ a**2  # sqrt(n) m, mean of squares
        if n_classes == 1:
            return _ratio(means**2, moments)[0]
        within = np.maximum(sizes * moments - means**2, 0.0)
        pooled = within.sum(axis=0) / max(len(a) - n_classes, 1)
        weights = _ratio(sizes**2, within + pooled)
        means = means / np.sqrt(sizes)
        centre = _ratio(np.sum(weights * means, axis=0), weights.sum(axis=0))
        return np.asarray(np.sum(weights * (means - centre) ** 2, axis=0))

    return np.array([statistic(a) for a in (alpha, *permuted)])


def _ratio(above: NDArray, below: NDArray) -> NDArray:
    """Return a ratio, zero where the divisor is."""
    above, below = np.broadcast_arrays(above, below)
    return np.divide(above, below, where=below > 0, out=np.zeros(below.shape))


def _signed(
    alpha: NDArray, labels: csr_array, by_group: csr_array, signs: NDArray
) -> NDArray:
    """Return statistics (n, n_components) for signs (n, n_groups).

    ``sum_c (sum_g s_g u_gc)^2 / sum_g u_gc^2`` with the covariances u_gc of a group and
    a label, of coefficients less their means over groups.
    """
    found = []
    for a in alpha.T:
        covariances = (by_group @ labels.multiply(a[:, None])).toarray()
        shares = _ratio((signs @ covariances) ** 2, np.sum(covariances**2, axis=0))
        found.append(shares.sum(axis=1))
    return np.stack(found, axis=1)


def _people_repeat(alpha: NDArray, labels: csr_array) -> bool:
    """Return whether near frames have one label more often than coefficients tell.

    Each class, or quarter of the ranks, has a normal distribution of the coefficients.
    If frames are independent, so are the errors of the predicted classes.
    """
    classes = labels.indices
    if labels.shape[1] == 1:
        classes = rankdata(labels.toarray()[:, 0]) * 4 // (len(alpha) + 1)
    classes = np.unique(classes, return_inverse=True)[1]
    variance, axes = np.linalg.eigh(alpha.T @ alpha / len(alpha))
    kept = variance > OF_DIFFERENCES * max(variance[-1], OF_DIFFERENCES)
    z, K = alpha @ axes[:, kept] / np.sqrt(variance[kept]), int(kept.sum())
    if not K or len(z) <= 2 * NEAREST:
        return False
    scores = []
    for number, size in enumerate(np.bincount(classes)):
        members = z[classes == number]
        residuals = members - members.mean(axis=0)
        covariance = (residuals.T @ residuals + np.eye(K)) / (size + 1)
        density = multivariate_normal(members.mean(axis=0), covariance)
        scores.append(np.log(size) + density.logpdf(z))
    errors = (classes[:, None] == np.arange(len(scores))) - softmax(scores, axis=0).T
    near = cKDTree(z).query(z, NEAREST + 1)[1][:, 1:]
    pairs = np.column_stack([np.repeat(np.arange(len(z)), NEAREST), near.ravel()])
    first, second = np.unique(np.sort(pairs, axis=1), axis=0).T
    products = np.vecdot(errors[first], errors[second])
    limit = norm.isf(REPEATED_LEVEL) * np.linalg.norm(products)
    return bool(products.sum() > limit)


class Association(NamedTuple):
    """
    Association of each coefficient with a label.

    Attributes
    ----------
    kind : {"classes", "number"}
        Kind of the labels.
    statistic : ndarray of shape (n_components,)
        Eta squared for classes: the share of the variance of a coefficient that lies
        between the classes, from 0 to 1. Spearman's rank correlation for numbers, from
        -1 to 1.
    p_value : ndarray of shape (n_components,)
        Permutation p-values, corrected for the number of coefficients. Each is the
        share of permutations in which this coefficient, or any weaker one, has at least
        the observed statistic. NaN if they cannot be tested.
    n_frames : int
        Number of frames with coefficients; copies of a frame count once.
    permuted : str
        The units that were permuted: "groups", "frames", or, if neighbouring frames
        depend on each other, "frequencies" or "blocks of 40 frames"; with "within
        groups" if they were permuted within groups.
    untested : str
        Why there are no p-values; empty if there are.
    corrected : ndarray of shape (n_components,) or None
        The statistic corrected for attenuation: that of coefficients without errors, an
        estimate that can exceed one. None without `alpha_std`.
    """

    kind: str
    statistic: NDArray
    p_value: NDArray
    n_frames: int
    permuted: str
    untested: str = ""
    corrected: NDArray | None = None

    def __repr__(self) -> str:
        """Return the results as a table and what they are."""
        name, meaning = TEXTS["statistics"][self.kind]
        columns = {"": [f"alpha_{k + 1}" for k in range(len(self.p_value))]}
        columns[name] = [f"{value:.2f}" for value in self.statistic]
        if self.corrected is not None:
            columns["corrected"] = [f"{value:.2f}" for value in self.corrected]
        columns["p"] = ["" if self.untested else f"{p:.3f}" for p in self.p_value]
        test = f"p-values: permutations of {self.permuted}"
        if self.untested:
            test = f"no p-values: {self.untested}"
        return f"{aligned(columns)}\n{name}: {meaning}; {test}; {self.n_frames} frames"

    def to_frame(self) -> "pd.DataFrame":
        """
        Return the results as a table.

        Returns
        -------
        DataFrame
            A row for each coefficient, counted from 1, with its statistic, the
            corrected one if it is known, and p_value.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        name = "eta_squared" if self.kind == "classes" else "spearman"
        index = pd.RangeIndex(1, len(self.statistic) + 1, name="component")
        columns = {name: self.statistic, f"{name}_corrected": self.corrected}
        columns = {key: each for key, each in columns.items() if each is not None}
        columns["p_value"] = self.p_value
        return pd.DataFrame(columns, index=index)


def association(
    alpha: Any,
    y: Any,
    groups: Any = None,
    *,
    time: Any = None,
    alpha_std: Any = None,
    kind: str = "auto",
    n_permutations: int = 999,
    random_state: Any = None,
) -> Association:
    """
    Test the association of each coefficient with a label of the frames.

    Parameters
    ----------
    alpha : array-like of shape (n_frames, n_components)
        Coefficients. Frames with NaN are left out.
    y : array-like of shape (n_frames,)
        A label for each frame: classes, such as expressions, or a number, such as an
        age.
    groups : array-like of shape (n_frames,), default=None
        People, videos or other groups with similar frames. Means of labels over
        groups are permuted among the groups, differences from them within each group.
    time : array-like of shape (n_frames,), default=None
        Times of the frames; None for the order of the rows. If neighbours in time
        depend on each other, frequencies or blocks are permuted instead of frames.
        Without groups, the runs between gaps of the times are groups.
    alpha_std : array-like of shape (n_frames, n_components), default=None
        Posterior standard deviations of the coefficients, `alpha_std_`. If given, the
        statistic is also corrected for attenuation by them.
    kind : {"auto", "classes", "number"}, default="auto"
        Kind of the labels. "auto" treats names, booleans and whole numbers as classes,
        as scikit-learn does.
    n_permutations : int, default=999
        Number of permutations. The least p-value is one over this number plus one.
    random_state : int, RandomState instance or None, default=None
        Seed of the permutations.

    Returns
    -------
    Association
        Named tuple of kind, statistic, p_value (n_components,), n_frames, permuted,
        untested and corrected.

    Raises
    ------
    ValueError
        If labels are missing, infinite, all equal, or classes that are all different.

    Notes
    -----
    The p-values are those of step-down maximum statistics (Westfall, Young,
    "Resampling-based multiple testing", 1993): without any association, the probability
    that any of them falls below a level is at most that level.

    If labels differ both between and within groups, both parts are tested together.
    Each part is divided by its mean over the permutations, and the parts are summed.

    p-values are for equal means, or no rank correlation: classes may differ in spread.
    The statistics of independent frames and of groups are studentised (Chung, Romano,
    "Exact and asymptotically robust permutation tests", 2013). With eight groups and
    more, what each adds within it gets random signs, if labels stay the same over
    neighbours or these depend on each other, as in sessions. If frames repeat people
    that are not given, nearest neighbours have one label: then there are no p-values.

    A correlation with a coefficient of errors is too small by the root of its
    reliability, eta squared by the reliability (Spearman, "The proof and measurement of
    association between two things", 1904): the variance of the coefficient over that
    variance plus the mean square of `alpha_std`.

    Neighbouring frames are compared after removal of the part of the coefficients that
    labels explain. Frames sorted by their label can thus be independent. If they are
    not, the frequencies of the coefficients (cosine transform) get random signs and
    sizes; if they are sorted, blocks are permuted. There are no p-values for less than
    eight blocks, or two frequencies that coefficients and labels share, in effect: a
    drift and a label that changes once, or regular rhythms. Neither are there any for
    joined clips, which are recognised by jumps, without `groups`.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.analysis import association
    >>> rng = np.random.default_rng(0)
    >>> alpha, smile = rng.normal(size=(200, 2)), np.repeat(["no", "yes"], 100)
    >>> alpha[smile == "yes", 1] += 2
    >>> found = association(alpha, smile, random_state=0)
    >>> found.p_value < 0.01
    array([False,  True])
    """
    check_scalar(n_permutations, "n_permutations", Integral, min_val=1)
    given = alpha
    alpha, labels, _, order = _known_frames(alpha, y, groups, time)
    kind = _frame_columns.kind_of(labels, kind)
    columns, classes = _label_columns(labels, kind), kind == "classes"
    standard = unit_columns(alpha if classes else rankdata(alpha, axis=0))
    covariances = columns.T @ standard
    statistic = np.sum(covariances**2, axis=0) if classes else covariances[0]
    rng = check_random_state(random_state)
    energies, permuted, untested = permuted_energies(
        alpha, standard, columns, order, n_permutations, rng
    )
    p_value = np.full(len(statistic), np.nan)
    if not untested:  # the sum of the parts between and within groups, of mean one
        total = np.sum([each / (each.mean() or 1.0) for each in energies], axis=0)
        p_value = _step_down_p_values(total)
    units = ", and ".join(permuted)
    found = Association(kind, statistic, p_value, len(alpha), units, untested)
    if alpha_std is None:
        return found
    ratio = _reliability(given, alpha_std)
    return found._replace(corrected=statistic / (ratio if classes else np.sqrt(ratio)))


def predictability(
    features: Any,
    y: Any,
    groups: Any = None,
    *,
    time: Any = None,
    kind: str = "auto",
    n_folds: int = 5,
    random_state: Any = None,
) -> NDArray:
    """
    Return the cross-validated prediction of a label from all features.

    Parameters
    ----------
    features : array-like of shape (n_frames, n_features)
        Coefficients, or other features to compare with. Frames with NaN are left out.
    y : array-like of shape (n_frames,)
        A label for each frame.
    groups : array-like of shape (n_frames,), default=None
        People, videos or other groups. Frames of a group are in one fold.
    time : array-like of shape (n_frames,), default=None
        See `association`. Without groups, blocks of dependent frames are in one fold.
    kind : {"auto", "classes", "number"}, default="auto"
        See `association`.
    n_folds : int, default=5
        Number of folds; fewer where a class has fewer frames, or if there are fewer
        groups.
    random_state : int, RandomState instance or None, default=None
        Seed of the folds.

    Returns
    -------
    ndarray of shape (n_folds,)
        For classes the accuracy of linear discriminant analysis of the standardised
        features. For numbers R^2 of ridge regression on them.

    Raises
    ------
    ValueError
        As in `association`, or if a class or the table is too small for two folds.
    """
    check_scalar(n_folds, "n_folds", Integral, min_val=2)
    features, labels, numbers, order = _known_frames(features, y, groups, time)
    kind = _frame_columns.kind_of(labels, kind)
    if groups is None:  # blocks of frames that depend on each other
        columns, numbers = _label_columns(labels, kind)[order.rows], None
        residuals = unexplained(unit_columns(features)[order.rows], columns, order)
        if (length := independent_length(residuals)) > 1:
            numbers = np.empty(len(labels), dtype=int)
            numbers[order.rows] = order.blocks(min(length, -(-len(labels) // n_folds)))
    most, model, splitter = len(labels), RidgeCV(np.logspace(-3, 3, 13)), "KFold"
    if numbers is not None:
        most, splitter = len(np.unique(numbers)), "GroupKFold"
    if kind == "classes":
        most = min(most, np.unique(labels, return_counts=True)[1].min())
        model, splitter = LinearDiscriminantAnalysis(), f"Stratified{splitter}"
    if most < 2:
        raise ValueError(
            "two folds need two frames of each class, and two groups where there are "
            f"groups; got {most}"
        )
    options = {"shuffle": True, "random_state": random_state}
    folds = getattr(model_selection, splitter)(int(min(n_folds, most)), **options)
    model = make_pipeline(StandardScaler(), model)
    return cross_val_score(model, features, labels, groups=numbers, cv=folds)


def _known_frames(
    features: Any, y: Any, groups: Any, time: Any
) -> tuple[NDArray, NDArray, NDArray | None, FrameOrder]:
    """Return features, labels, groups and order of different frames without NaN."""
    features = check_array(
        features, dtype=np.float64, ensure_all_finite="allow-nan", input_name="alpha"
    )
    finite = np.flatnonzero(np.isfinite(features).all(axis=1))
    if not len(finite):
        raise ValueError("no frame has coefficients: all rows of alpha have NaN")
    labels = _frame_columns.checked_column("y", y, len(features))
    _frame_columns.refuse_infinite("y", labels, np.arange(len(features)))
    seconds = _frame_columns.checked_times(time, len(features))
    if groups is None and time is not None:  # gaps are no jumps of a clip
        groups = _frame_columns.runs_between_gaps(seconds)
    numbers = _frame_columns.group_numbers(groups, len(features))
    classes = np.unique(labels, return_inverse=True)[1][finite]
    rows = np.column_stack([_rounded(features[finite]), classes])
    finite = finite[np.sort(np.unique(rows, axis=0, return_index=True)[1])]
    order = FrameOrder(numbers[finite], seconds[finite])
    return features[finite], labels[finite], numbers[finite], order


def _reliability(alpha: Any, alpha_std: Any) -> NDArray:
    """Return the shares (K,) of the variance of coefficients that are no errors."""
    alpha = np.asarray(alpha, float)
    deviations = _frame_columns.checked_std(alpha_std, alpha)
    variance = np.nanvar(alpha, axis=0)
    total = variance + np.nanmean(deviations**2, axis=0)
    return np.asarray(variance / np.where(total > 0, total, np.nan))


def _rounded(features: NDArray) -> NDArray:
    """Round features (n, k), so that copies of a frame are equal, and few others.

    Crops and conversions of an image move its points by rounding errors. To at most a
    thousandth of the standard deviations: about one of 100 other frames has an equal.
    """
    (n, k), size = features.shape, features.std(axis=0)
    precision = min(1e-3, 2.0 * (0.02 / n) ** (1.0 / k))
    return np.rint(features / (precision * np.where(size > 0, size, 1.0)))


def _step_down_p_values(energies: NDArray) -> NDArray:
    """Return p-values (K,) of energies (n, K), of which the first row is observed."""
    weakest_first = np.argsort(energies[0], kind="stable")
    energies = energies[:, weakest_first]
    largest = np.maximum.accumulate(energies, axis=1)
    # Tolerance for rounding: equal energies count as large.
    larger = (largest >= energies[0] * (1 - OF_DIFFERENCES)).mean(axis=0)
    p_value = np.maximum.accumulate(larger[::-1])[::-1]
    return p_value[np.argsort(weakest_first)]


def _label_columns(labels: NDArray, kind: str) -> csr_array:
    """Return ranks, or indicators of classes, as columns (n_frames, n_columns).

    The sum of their squared covariances with a column of norm one is eta squared, or
    the square of Spearman's rank correlation.
    """
    if kind == "number":
        return _unit(csr_array(rankdata(labels)[:, None]))
    return _unit(indicators(np.unique(labels, return_inverse=True)[1]))
