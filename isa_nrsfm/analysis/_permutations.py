"""Permutations of labels among people, and among blocks of dependent frames.

Labels may be permuted only between units that are exchangeable under the null
hypothesis of no association (Winkler, Webster, Vidaurre, Nichols, Smith, "Multi-level
block permutation", 2015). The means of labels over groups are permuted among the
groups. The differences from these means are permuted within each group: frame by frame,
or in blocks if neighbouring frames of a video depend on each other.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from isa_nrsfm.analysis._within_groups import between_share

# Sum of squares, relative to that of the labels, that is due to rounding errors.
ROUNDING = 1e-20


class FrameOrder(NamedTuple):
    """Frames sorted by group, and by time within each group."""

    rows: NDArray  # numbers of the frames in this order
    groups: NDArray  # ascending number of the group of each frame
    sizes: NDArray  # number of frames of each group

    @classmethod
    def of(cls, groups: NDArray, time: NDArray) -> "FrameOrder":
        """Sort frames by groups (n_frames,) and time (n_frames,)."""
        numbers = np.unique(groups, return_inverse=True)[1]
        rows = np.lexsort((time, numbers))
        return cls(rows, numbers[rows], np.bincount(numbers))

    @property
    def first(self) -> NDArray:
        """Place of the first frame of each group (n_groups,)."""
        return np.asarray(np.cumsum(self.sizes) - self.sizes)

    def means(self, values: NDArray) -> NDArray:
        """Average ordered values (n_frames, k) over each group (n_groups, k)."""
        return np.asarray(np.add.reduceat(values, self.first) / self.sizes[:, None])

    def blocks(self, length: int) -> NDArray:
        """Number the blocks of `length` ordered frames within groups (n_frames,)."""
        place = np.arange(len(self.rows)) - self.first[self.groups]
        n_blocks = -(-self.sizes // length)
        first = np.cumsum(n_blocks) - n_blocks
        return np.asarray(place // length + first[self.groups])


def dependent_blocks(
    alpha: NDArray, labels: NDArray, order: FrameOrder
) -> tuple[int, NDArray]:
    """Return the length of blocks much longer than the autocorrelation of frames.

    Also returns the share of the variance of a covariance (n_components,) that is lost
    at the cuts. Coefficients and labels are ordered, and relative to the mean of their
    group.

    The covariance of two unrelated series has ``1 + 2 sum_h r_h s_h`` times the
    variance for independent frames, with the autocorrelations r and s of the series
    (Bartlett, "Some aspects of the time-correlation problem", 1935). So frames count as
    independent, with length one, if the labels or the coefficients are.
    """
    n_frames, n_components = alpha.shape
    # With 5 and with 10 autocorrelation times a block, 3 to 7 % of random labels in
    # blocks have p <= .05 (autoregressions of .3 to .98, 150 to 570 frames); the power
    # is larger with 5.
    n_times = 5
    # Neighbours of one class are alike because of the class: measure the residuals.
    rest = alpha - labels @ np.linalg.lstsq(labels, alpha)[0]
    energy, of_labels = np.sum(rest**2, axis=0), np.sum(labels**2)
    energy[energy <= ROUNDING * np.sum(alpha**2, axis=0)] = np.inf
    least = norm.isf(0.05 / n_components) / np.sqrt(n_frames)
    time, straddling = np.ones(n_components), np.zeros(n_components)
    growing = np.ones(n_components, dtype=bool)
    for lag in range(1, int(order.sizes.max())):
        pairs = order.groups[lag:] == order.groups[:-lag]
        share = np.count_nonzero(pairs) / n_frames
        r = np.sum((rest[lag:] * rest[:-lag])[pairs], axis=0) / (share * energy)
        s = np.sum((labels[lag:] * labels[:-lag])[pairs]) / (share * of_labels)
        if lag == 1:
            growing = (r > least) & (s > least)
        growing &= (r > 0) & (s > 0)
        if not growing.any() or n_times * time.max() > order.sizes.max():
            break
        time[growing] += 2 * share * (r * s)[growing]
        straddling[growing] += 2 * lag * (r * s)[growing]
    if time.max() == 1:
        return 1, np.zeros(n_components)
    length = int(np.ceil(n_times * time.max()))
    # Each cut separates `lag` pairs of frames for each lag.
    n_cuts = np.sum(np.where(order.sizes > 1, -(-order.sizes // length), 0))
    return length, np.minimum(n_cuts * straddling / (n_frames * time), 0.5)


def permutations_within(
    order: FrameOrder, length: int, n_permutations: int, rng: np.random.RandomState
) -> Iterator[NDArray]:
    """Yield permutations (n_frames,) of ordered frames within their groups.

    Groups are shifted circularly, cut into blocks (if longer), and these are shuffled.
    """
    block = order.blocks(length)
    starts, lengths = np.flatnonzero(np.diff(block, prepend=-1)), np.bincount(block)
    first, sizes = order.first[order.groups], order.sizes[order.groups]
    for _ in range(n_permutations):
        keys = rng.random_sample(len(starts))
        shuffled = np.lexsort((keys, order.groups[starts]))
        moved = lengths[shuffled]
        by = starts[shuffled] - (np.cumsum(moved) - moved)
        place = np.arange(len(block)) + np.repeat(by, moved)
        shift = np.floor(rng.random_sample(len(order.sizes)) * order.sizes).astype(int)
        yield first + (place - first + shift[order.groups]) % sizes


def permuted_energies(
    alpha: NDArray,
    labels: NDArray,
    order: FrameOrder,
    n_permutations: int,
    rng: np.random.RandomState,
) -> tuple[NDArray, str]:
    """
    Compute squared covariances of coefficients with labels, and with permuted labels.

    Returns them (n_permutations + 1, n_components), the given labels first, and the
    permuted units. The parts between and within groups are summed, each divided by its
    mean over the permutations.
    """
    alpha, labels = alpha[order.rows], labels[order.rows]
    total = np.sum((labels - labels.mean(axis=0)) ** 2)
    means, of_labels = order.means(alpha), order.means(labels)
    weights = _weights(labels, order)
    alpha, labels = alpha - means[order.groups], labels - of_labels[order.groups]
    energies, permuted = np.zeros((n_permutations + 1, alpha.shape[1])), []
    between = _standard(of_labels, weights)
    if np.sum(between**2) > ROUNDING * total:
        orders = (rng.permutation(len(means)) for _ in range(n_permutations))
        energies += _energies(_standard(means, weights), between, orders, 1.0)
        permuted.append("groups")
    if np.sum(labels**2) > ROUNDING * total:
        length, loss = dependent_blocks(alpha, labels, order)
        permutations = permutations_within(order, length, n_permutations, rng)
        energies += _energies(alpha, labels, permutations, 1.0 / (1.0 - loss))
        units = "frames" if length == 1 else f"blocks of {length} frames"
        if 1 < order.sizes.max() <= length:
            units = "sequences shifted in time"
        permuted.append(f"{units} within groups" if len(means) > 1 else units)
    return energies, ", and ".join(permuted)


def _weights(labels: NDArray, order: FrameOrder) -> NDArray:
    """Return weights (n_groups, 1) with which means of labels have equal variances."""
    sizes = order.sizes[:, None]
    if (sizes == sizes[0]).all():
        return np.ones(sizes.shape)
    share = between_share(labels, order.groups).between
    share = np.average(share, weights=np.var(labels, axis=0))
    return np.asarray(1.0 / np.sqrt(share + (1.0 - share) / sizes))


def _standard(means: NDArray, weights: NDArray) -> NDArray:
    """Weight the means of groups (n_groups, k), relative to their mean."""
    centre = np.sum(weights**2 * means, axis=0) / np.sum(weights**2)
    weighted = weights * (means - centre)
    return np.asarray(weighted - weighted.mean(axis=0))


def _energies(
    alpha: NDArray,
    labels: NDArray,
    permutations: Iterable[NDArray],
    inflation: NDArray | float,
) -> NDArray:
    """Return squared covariances (n_permutations + 1, n_components) of mean one."""
    energy = np.sum(alpha**2, axis=0)
    alpha = alpha / np.sqrt(np.where(energy > 0, energy, 1.0))
    orders = [np.arange(len(labels)), *permutations]
    energies = np.array([np.sum((labels[i].T @ alpha) ** 2, axis=0) for i in orders])
    energies[1:] *= inflation
    return np.asarray(energies / (energies.mean() or 1.0))
