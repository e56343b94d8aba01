"""What is loaded or computed when it is first used: names, libraries, properties.

Public names are imported when they are first used (SPEC 1). An ``__init__.py`` imports
them under `TYPE_CHECKING`, which `lazy_names` reads.
"""

import ast
import os
import sys
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

# Environment variable of SPEC 1 that turns lazy imports off.
EAGER = "EAGER_IMPORT"


def lazy_names(
    package: str,
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package with lazy names.

    Names that are imported from the package itself are folders. Errors of imports are
    raised unchanged, and at once if `EAGER_IMPORT` is set.
    """
    namespace = vars(sys.modules[package])
    modules = {
        alias.name: str(node.module)
        for block in ast.parse(namespace["__loader__"].get_source(package)).body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }

    def imported(name: str) -> Any:
        if name not in modules:
            raise AttributeError(
                f"module {package!r} has no attribute {name!r}",
                name=name,
                obj=sys.modules[package],
            )
        if modules[name] == package:
            return import_module(f"{package}.{name}")
        namespace[name] = getattr(import_module(modules[name]), name)
        return namespace[name]

    def listed() -> list[str]:
        special = [name for name in namespace if name.startswith("__")]
        return sorted([*modules, *special])

    if os.environ.get(EAGER):
        for name in modules:
            imported(name)
    return imported, listed, [name for name in modules if modules[name] != package]


def import_optional(name: str, *, extra: str) -> Any:
    """Import a module; the error names the extra of the package that installs it."""
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{name.partition('.')[0]} is needed here and is not installed: "
            f'pip install "isa-nrsfm[{extra}]"'
        ) from error


if TYPE_CHECKING:
    from functools import cached_property as cached_property
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
