"""Parameters of tests that belong to the quick layer, and others that do not."""

import pytest


def slow_after(n_quick, values, together=False):
    """Return parameters of which those after the first ones are slow.

    With `together` each value has those of several arguments.
    """
    sets = [value if together else (value,) for value in values]
    marks = [[]] * n_quick + [pytest.mark.slow] * len(sets)
    return [pytest.param(*each, marks=m) for each, m in zip(sets, marks, strict=False)]
