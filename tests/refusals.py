"""Calls that are refused."""

import pytest


def refused(message, call, /, *args, error=ValueError, **kwargs):
    """Check that a call raises an error whose message matches, and return the error."""
    with pytest.raises(error, match=message) as caught:
        call(*args, **kwargs)
    return caught.value
