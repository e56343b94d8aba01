"""Tables and models that tests share."""

from functools import cache, wraps
from inspect import signature


def made_once(function):
    """Keep results, however arguments are given: by place, by name, by default."""
    kept, parameters = cache(function), signature(function)

    @wraps(function)
    def result(*args, **kwargs):
        given = parameters.bind(*args, **kwargs)
        given.apply_defaults()
        return kept(*given.args, **given.kwargs)

    return result
