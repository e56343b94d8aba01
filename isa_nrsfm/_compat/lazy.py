"""Public names that are imported when they are first used (SPEC 1).

The packages of a folder's public names list them three times: under `TYPE_CHECKING`,
for type checkers and editors; in ``__all__``; and for `lazy_names`, with the modules
that define them. `tests/test_conventions.py` holds the three against each other.

See https://scientific-python.org/specs/spec-0001/.
"""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

# The variable of the environment by which SPEC 1 asks for all imports at once.
EAGER = "EAGER_IMPORT"


def lazy_names(
    package: str,
    names: Mapping[str, Sequence[str]],
    subpackages: Sequence[str] = (),
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """
    Return ``__getattr__`` and ``__dir__`` of a package with lazy names.

    Where the environment has a non-empty `EAGER_IMPORT`, all names are imported at
    once, so that no import error stays hidden.

    Parameters
    ----------
    package : str
        Name of the package, its ``__name__``.
    names : dict of str to sequence of str
        For each module that defines public names of the package, these names.
    subpackages : sequence of str, optional
        Folders of the package that are imported when they are first used, too.

    Returns
    -------
    tuple of callable
        ``__getattr__`` imports a name and keeps it, so that it is asked for each name
        once. It raises AttributeError for all others, and lets the error of an import
        through. ``__dir__`` lists the names whether they are imported or not.
    """
    namespace = vars(sys.modules[package])
    modules = {name: module for module in names for name in names[module]}

    def imported(name: str) -> Any:
        if name in subpackages:
            return import_module(f"{package}.{name}")
        if name not in modules:
            raise AttributeError(
                f"module {package!r} has no attribute {name!r}",
                name=name,
                obj=sys.modules[package],
            )
        namespace[name] = getattr(import_module(modules[name]), name)
        return namespace[name]

    def listed() -> list[str]:
        return sorted({*namespace, *modules, *subpackages})

    if os.environ.get(EAGER):
        for name in (*modules, *subpackages):
            imported(name)
    return imported, listed
