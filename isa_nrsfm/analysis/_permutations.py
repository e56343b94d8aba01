"""Permutations of labels among people and frames, and of the frequencies of videos.

Labels may be permuted only between units that are exchangeable under the null
hypothesis of no association (Winkler, Webster, Vidaurre, Nichols, Smith, "Multi-level
block permutation", 2015). The means of labels over groups are permuted among the
groups, and independent frames within each group. If neighbouring frames of a video
depend on each other, the frequencies of the coefficients are independent instead: the
cosine transform nearly diagonalises the covariance of any stationary series, and of
random walks.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from scipy.sparse import csr_array, hstack
from scipy.sparse.linalg import lsmr
from scipy.stats import norm

from isa_nrsfm._linalg.rounding import OF_DIFFERENCES

# Why a label cannot be tested.
ONE_EVENT = (
    "the coefficients and the label change slowly or with one period: they have one "
    "event in common, which may be chance. Record more events, or give several people "
    "or videos as groups"
)
JUMPS = (
    "the coefficients jump {} times, first after {} frames, as where clips are joined. "
    "Give the clips as groups"
)


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

    def means(self, values: NDArray) -> NDArray:
        """Average ordered values (n_frames, k) over each group (n_groups, k)."""
        return np.asarray(np.add.reduceat(values, self.first) / self.sizes[:, None])

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
    n_scales = max(1, int(np.log2(len(rest) / 8)) + 1)
    least = norm.isf(0.05 / (rest.shape[1] * n_scales))
    length, scale = 1, 1
    while len(rest) >= 8:
        energy = np.sum(rest**2, axis=0)
        r = np.sum(rest[1:] * rest[:-1], axis=0) * np.sqrt(len(rest))
        scale *= 2
        if np.any(r > least * energy):
            length = 5 * scale
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
) -> tuple[NDArray, str, str]:
    """
    Compute squared covariances of coefficients with labels, and with permuted labels.

    Coefficients are given as values, and as ranks or values of norm one (alpha).
    Returns them (n_permutations + 1, n_components), the given labels first; the
    permuted units; and why they are no test, or nothing. The parts between and within
    groups are summed, each divided by its mean over the permutations.
    """
    alpha, labels = alpha[order.rows], labels[order.rows]
    n_components = alpha.shape[1]
    sizes = order.sizes[:, None]
    means = order.means(alpha)
    # Sparse: there may be as many classes as groups.
    of_labels = (indicators(order.groups).T @ labels).multiply(1.0 / sizes).tocsr()
    alpha = alpha - means[order.groups]
    square = np.sum(labels.data**2)
    total = square - len(alpha) * np.sum((sizes.T @ of_labels / len(alpha)) ** 2)
    energies, permuted = np.zeros((n_permutations + 1, n_components)), []
    untested = ""
    weights = _weights(labels, of_labels, order)
    between = of_labels.multiply(weights).tocsr()
    # Less the mean of the labels: a part along the weights, and one along ones
    along = weights / np.sqrt(np.sum(weights**2))
    part = along.T @ between
    mean = between.sum(axis=0) - np.sum(along) * part
    energy = np.sum(between.data**2) - np.sum(part**2) - np.sum(mean**2) / len(means)
    if energy > OF_DIFFERENCES * total:
        centres = _standard(means, weights)
        orders = (rng.permutation(len(means)) for _ in range(n_permutations))
        permuted_centres = (centres[i] for i in orders)
        energies += _energies(centres, between, permuted_centres, along)
        permuted.append("groups")
    if square - np.sum(sizes.T @ of_labels.power(2)) > OF_DIFFERENCES * total:
        rest = unexplained(alpha, labels, order)
        length, in_runs = independent_length(rest), _are_sorted(labels, order)
        units, one_event = f"blocks of {length} frames", 8 * length > len(alpha)
        # Blocks of frames, permuted within groups
        block = order.blocks(length)
        places = (
            rng.random_sample(block[-1] + 1)[block] for _ in range(n_permutations)
        )
        shuffled: Iterator[NDArray] = (
            alpha[np.lexsort((place, order.groups))] for place in places
        )
        if length == 1:
            units = "frames"
        elif not in_runs:
            units, shuffled = "frequencies", _waves(alpha, order, n_permutations, rng)
            one_event = _one_event(alpha, labels, order)
        if length > 1 and not permuted:
            untested = ONE_EVENT * one_event
            if len(means) == 1:
                cuts = np.intersect1d(seams(values[order.rows]), seams(rest))
                if len(cuts):
                    untested = JUMPS.format(len(cuts), cuts[0])
        if not untested:
            energies += _energies(alpha, labels, shuffled)
        permuted.append(f"{units} within groups" if len(means) > 1 else units)
    return energies, ", and ".join(permuted), untested


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
) -> Iterator[NDArray]:
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
    """Return squared covariances (n_permutations + 1, n_components) of mean one.

    The part of the labels along a column `without` (n, 1) of norm one does not count.
    """
    energy = np.sum(alpha**2, axis=0)
    rests = (a - without * np.sum(without * a, axis=0) for a in (alpha, *permuted))
    energies = np.array([np.sum((labels.T @ a) ** 2, axis=0) for a in rests])
    energies /= np.where(energy > 0, energy, 1.0)
    return np.asarray(energies / (energies.mean() or 1.0))
