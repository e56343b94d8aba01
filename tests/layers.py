"""Parameters of tests of which some are slow, marks, and limits of estimators."""

import pytest

from isa_nrsfm._estimator import limited
from isa_nrsfm._joint.settings import LIMITS

# Of quick tests: joint fits have one start, and few steps for the errors of depths.
ONE_START = {"few_frames": 0, "widths": (), "restarts": False}
QUICK_LIMITS = ONE_START | {"error_steps": 3}

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


def with_limits(**limits):
    """Return a class of estimators with other limits than those of users."""
    return limited(LIMITS._replace(**limits))


# The second one has the errors of depths of users.
Quick, OneStart = with_limits(**QUICK_LIMITS), with_limits(**ONE_START)
