"""Calls that are refused, or that warn."""

import pytest


def refused(message, call, /, *args, error=ValueError, **kwargs):
    """Check that a call raises an error whose message matches, and return the error."""
    with pytest.raises(error, match=message) as caught:
        call(*args, **kwargs)
    return caught.value


def warned(message, call, /, *args, category=UserWarning, **kwargs):
    """Check that a call warns with a message that matches, and return its result."""
    with pytest.warns(category, match=message):
        return call(*args, **kwargs)
