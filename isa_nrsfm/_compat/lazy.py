"""Public names that are imported when they are first used (SPEC 1).

An ``__init__.py`` imports them under `TYPE_CHECKING`, which `lazy_names` reads.
"""

import ast
import os
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

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
    source = ast.parse(namespace["__loader__"].get_source(package))
    modules = {
        alias.name: str(node.module)
        for block in source.body
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
