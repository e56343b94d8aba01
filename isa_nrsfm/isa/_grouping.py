"""Grouping of signals into subspaces by greedy pairwise swaps."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_DIFFERENCES
from isa_nrsfm.isa._density import SubspaceDensity

# Takes an assignment (n_signals,) of signals to subspaces. Returns the gain (n_signals,
# n_signals) of the objective by a swap of any two signals. Also returns the size of the
# objective, to which rounding errors are relative.
Gains = Callable[[NDArray], tuple[NDArray, float]]


def swap_until_best(assignment: NDArray, gains: Gains) -> NDArray:
    """Swap the two signals with the largest gain, until no swap has a gain."""
    assignment = assignment.copy()
    while True:
        gain, size = gains(assignment)
        gain = np.where(assignment[:, None] == assignment, 0.0, gain)
        a, b = np.unravel_index(np.argmax(gain), gain.shape)
        if not gain[a, b] > OF_DIFFERENCES * size:
            return assignment
        assignment[[a, b]] = assignment[[b, a]]


def rows_by_subspace(assignment: NDArray) -> NDArray:
    """Return an order (n_signals,) of the signals that makes subspaces consecutive."""
    _, first, group = np.unique(assignment, return_index=True, return_inverse=True)
    return np.argsort(first[group], kind="stable")


def covariance_gains(covariance: NDArray) -> Gains:
    """Return the gains for pooling by a covariance (n_signals, n_signals).

    The objective is the energy of the covariance inside the diagonal blocks of the
    subspaces (Brandt et al. 2018, section 3.3).
    """
    energy = covariance**2
    total = float(energy.sum())
    diagonal = np.diag(energy)

    def gains(assignment: NDArray) -> tuple[NDArray, float]:
        member = assignment[:, None] == np.arange(assignment.max() + 1)
        # Half the gain of signal a in a swap with b. It gains the energy shared with
        # the subspace of b, without b, and loses that shared with its own subspace.
        with_subspace = energy @ member  # (n_signals, n_subspaces)
        with_b = with_subspace[:, assignment]  # of a with the subspace of b
        minus_own = diagonal - np.diag(with_b)
        gain = with_b - energy + minus_own[:, None]
        return gain + gain.T, total

    return gains


def value_gains(value: Callable[[NDArray], NDArray], n_signals: int) -> Gains:
    """Return the gains for a sum of values of groups (n_groups, subspace_size)."""
    # with_b[a, b] is the value of the subspace of a with a replaced by b. Row a depends
    # only on the mates of a, the signals of its subspace. A swap changes the mates of
    # two subspaces, so only their rows are computed again.
    with_b = np.zeros((n_signals, n_signals))
    mates_before = np.zeros((n_signals, n_signals), dtype=bool)
    everyone = np.arange(n_signals)

    def gains(assignment: NDArray) -> tuple[NDArray, float]:
        mates = assignment[:, None] == assignment
        for a in np.flatnonzero((mates != mates_before).any(axis=1)):
            rest = np.flatnonzero(mates[a] & (everyone != a))  # the mates of a
            instead = np.flatnonzero(~mates[a] | (everyone == a))
            groups = np.column_stack([np.tile(rest, (len(instead), 1)), instead])
            with_b[a, instead] = value(groups)
        mates_before[:] = mates
        own = np.diag(with_b)
        gain = with_b - own[:, None]
        return gain + gain.T, float(np.abs(own).sum())

    return gains


def likelihood_gains(signals: NDArray, density: SubspaceDensity) -> Gains:
    """Return the gains for the likelihood ``sum_k E F(u_k)`` of white signals."""
    square = signals**2

    def value(groups: NDArray) -> NDArray:
        energy = np.zeros((len(groups), square.shape[1]))
        for member in groups.T:
            energy += square[member]
        return density.log_density(energy).mean(axis=1)

    return value_gains(value, len(signals))
