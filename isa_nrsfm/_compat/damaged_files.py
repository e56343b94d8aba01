"""Errors that name their file, and one kind of error for damaged files."""

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def reading(
    path: str | os.PathLike[str], what: str, expected: str | None = None
) -> Iterator[None]:
    """Name the file in each reading error; raise ValueErrors for damaged content.

    Damaged content makes h5py, pyarrow, zipfile, json and others raise errors of many
    undocumented kinds. `what` is the kind of file, `expected` its required content.
    """
    try:
        yield
    except (ImportError, MemoryError):
        raise
    except Exception as error:
        # System errors have an errno, errors of libraries for bad content have none.
        if isinstance(error, OSError) and error.errno is not None:
            error.filename = os.fspath(path)
            raise
        said = _message(error).strip().partition("\n")[0]
        if not isinstance(error, ValueError | OSError):
            said = f"{type(error).__name__}: {said}"
        raise ValueError(
            f"{os.fspath(path)} cannot be read as {what}: {said}"
            + (f". Expected {expected}" if expected else "")
        ) from error


@contextlib.contextmanager
def errors_of(what: str) -> Iterator[None]:
    """Put a text before the messages of ValueErrors."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{what}: {_message(error)}") from error


def _message(error: Exception) -> str:
    """Return the message of an error; of text in another encoding, with the way."""
    if not isinstance(error, UnicodeDecodeError):
        return str(error)
    encoding = error.encoding.upper()
    return f"its text is not in {encoding} ({error}). Save it as {encoding}"
