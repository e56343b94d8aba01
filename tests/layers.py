"""Parameters of tests of which some are slow, and a mark of tests."""

import pytest

# The run of FastICA or FastISA that is kept may go round in a cycle; it says so.
may_not_converge = pytest.mark.filterwarnings(
    "ignore::sklearn.exceptions.ConvergenceWarning"
)
# The joint refinement does not say so of its start.
start_may_not_converge = pytest.mark.filterwarnings(
    "ignore:PooledFastICA did not converge"
)


def slow_after(n_quick, values):
    """Return parameters of which those after the first ones are slow.

    A tuple has the values of several arguments.
    """
    sets = [value if isinstance(value, tuple) else (value,) for value in values]
    marks = [[]] * n_quick + [pytest.mark.slow] * len(sets)
    return [pytest.param(*each, marks=m) for each, m in zip(sets, marks, strict=False)]
