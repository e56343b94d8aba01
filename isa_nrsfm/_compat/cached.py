"""Properties that are computed once."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from functools import cached_property
else:

    class cached_property:
        """`functools.cached_property` without the lock that it has in Python 3.11.

        A process that is forked while another Python thread holds it waits forever.
        """

        def __init__(self, function: Any) -> None:
            self.function, self.__doc__ = function, function.__doc__

        def __set_name__(self, owner: type, name: str) -> None:
            """Remember the name of the property."""
            self.name = name

        def __get__(self, held: Any, owner: type | None = None) -> Any:
            """Return the value, which then stands in the object."""
            if held is None:
                return self
            return held.__dict__.setdefault(self.name, self.function(held))


__all__ = ["cached_property"]
