"""Parameters of tests that belong to the quick layer, and others that do not."""

import pytest


def slow_after(n_quick, values, together=False):
    """Return parameters of which those after the first ones are slow.

    With `together` each value has those of several arguments.
    """
    return [
        pytest.param(
            *(value if together else [value]),
            marks=[] if i < n_quick else pytest.mark.slow,
        )
        for i, value in enumerate(values)
    ]
