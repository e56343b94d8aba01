"""All ways to group nine signals by three, and what a grouping holds inside."""

from itertools import combinations

import numpy as np


def all_groupings(items):
    """Return all ways to split items into groups of three."""
    if not items:
        return [[]]
    first, *others = items
    found = []
    for pair in combinations(others, 2):
        rest = [item for item in others if item not in pair]
        found += [[(first, *pair), *tail] for tail in all_groupings(rest)]
    return found


def as_assignment(groups):
    assignment = np.empty(3 * len(groups), dtype=int)
    for k, group in enumerate(groups):
        assignment[list(group)] = k
    return assignment


GROUPINGS = [as_assignment(groups) for groups in all_groupings(list(range(9)))]
assert len(GROUPINGS) == 280


def energy_inside(covariance, assignment):
    return np.sum(covariance[assignment[:, None] == assignment] ** 2)
