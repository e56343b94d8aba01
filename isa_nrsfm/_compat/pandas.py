"""pandas, imported when it is first used, so that no import of a module needs it."""

from typing import Any

from isa_nrsfm._compat.lazy import import_optional


def __getattr__(name: str) -> Any:
    """Return a name of pandas; the error names the extra that installs it."""
    return getattr(import_optional("pandas", extra="io"), name)
