"""Import optional dependencies where they are used."""

from importlib import import_module
from typing import Any


def import_optional(name: str, *, extra: str) -> Any:
    """Import a module; the error names the extra of the package that installs it."""
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ImportError(
            f"{package} is needed here and is not installed: "
            f'pip install "isa-nrsfm[{extra}]"'
        ) from error
