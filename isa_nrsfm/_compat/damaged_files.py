"""Errors that name their file, and one kind of error for damaged files."""

import contextlib
import csv
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from isa_nrsfm._compat.texts import printable


@contextlib.contextmanager
def reading(
    path: str | os.PathLike[str], what: str, expected: str | None = None
) -> Iterator[None]:
    """Name the file in each reading error; raise ValueErrors for damaged content.

    Damaged content makes h5py, pyarrow, zipfile, json and others raise errors of many
    undocumented kinds. `what` is the kind of file, `expected` its required content.
    """
    refuse_special(path)
    before = _state(path)
    try:
        yield
        if _state(path) != before:
            raise ValueError("it was changed while it was read: read it again later")
    except (ImportError, MemoryError):
        raise
    except Exception as error:
        # System errors have an errno, errors of libraries for bad content have none.
        if isinstance(error, OSError) and error.errno is not None:
            error.filename = os.fspath(path)
            raise
        said = _message(error).strip().partition("\n")[0]
        if isinstance(error, csv.Error) and "field limit" in said:
            said = "a cell has more than 131,072 characters, or a quotation mark no end"
        elif not isinstance(error, ValueError | OSError):
            said = f"{type(error).__name__}: {said}"
        raise ValueError(
            f"{os.fspath(path)} cannot be read as {what}: {said}"
            + (f". Expected {expected}" if expected else "")
        ) from error


def _state(path: str | os.PathLike[str]) -> tuple[int, int] | None:
    """Return size and time of the last change of a file; None if there is none."""
    found = Path(path).stat() if Path(path).exists() else None
    return None if found is None else (found.st_size, found.st_mtime_ns)


def refuse_special(path: str | os.PathLike[str]) -> None:
    """Raise if a path is a pipe or a device: readers open a file several times."""
    if Path(path).exists() and not (Path(path).is_file() or Path(path).is_dir()):
        reason = "is a pipe or a device. Save its content as a file"
        raise OSError(errno.EINVAL, reason, os.fspath(path))


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
        return printable(str(error))
    encoding = error.encoding.upper()
    return f"its text is not in {encoding} ({error}). Save it as {encoding}"
