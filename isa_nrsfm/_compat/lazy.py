"""Public names that are imported when they are first used (SPEC 1).

An ``__init__.py`` lists them under `TYPE_CHECKING` and for `lazy_names`.
"""

import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

# Environment variable of SPEC 1 that turns lazy imports off.
EAGER = "EAGER_IMPORT"


def lazy_names(
    package: str, names: Mapping[str, str], subpackages: str = ""
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package with lazy names.

    `names` maps modules of the package to their public names, and `subpackages` are
    folders, with blanks between them. Errors of imports are raised unchanged, and at
    once if `EAGER_IMPORT` is set.
    """
    namespace, folders = vars(sys.modules[package]), subpackages.split()
    modules = {name: module for module in names for name in names[module].split()}

    def imported(name: str) -> Any:
        if name in folders:
            return import_module(f"{package}.{name}")
        if name not in modules:
            raise AttributeError(
                f"module {package!r} has no attribute {name!r}",
                name=name,
                obj=sys.modules[package],
            )
        namespace[name] = getattr(import_module(f"{package}.{modules[name]}"), name)
        return namespace[name]

    def listed() -> list[str]:
        return sorted({*namespace, *modules, *folders})

    if os.environ.get(EAGER):
        for name in (*modules, *folders):
            imported(name)
    return imported, listed, list(modules)
