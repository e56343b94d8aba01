"""All ways to group nine signals by three, and what a grouping holds inside."""

from itertools import product

import numpy as np


def is_grouping(labels):
    """Tell whether there are three of each label, which begin in their order."""
    in_order = [*dict.fromkeys(labels)] == [0, 1, 2]
    return in_order and np.bincount(labels).tolist() == [3, 3, 3]


GROUPINGS = np.array([*filter(is_grouping, product(range(3), repeat=9))])
assert len(GROUPINGS) == 280


def energy_inside(covariance, assignment):
    return np.sum(covariance[assignment[:, None] == assignment] ** 2)
