"""Files: errors of reading that name them, and files written as a whole or not at all.

New contents are written to a hidden file or folder beside the old ones. Its name begins
with `ASIDE`. Then `os.replace` moves them to their place. A write that fails removes
the hidden file. A killed process leaves it behind: it can be deleted.
"""

import contextlib
import csv
import errno
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

from isa_nrsfm._compat.texts import printable

ASIDE = ".isa-nrsfm-"
StrPath = str | os.PathLike[str]


@contextlib.contextmanager
def reading(path: StrPath, what: str, expected: str | None = None) -> Iterator[None]:
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


def _state(path: StrPath) -> tuple[int, int] | None:
    """Return size and time of the last change of a file; None if there is none."""
    found = Path(path).stat() if Path(path).exists() else None
    return None if found is None else (found.st_size, found.st_mtime_ns)


def refuse_special(path: StrPath) -> None:
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


def write_whole(path: StrPath, contents: bytes) -> None:
    """Write a file as `whole_file` does."""
    with whole_file(path) as file:
        file.write(contents)


@contextlib.contextmanager
def whole_file(path: StrPath) -> Iterator[IO[bytes]]:
    """Open a file that is replaced after the block, or unchanged if the block fails.

    Permissions and links stay. A path that is no regular file, such as a pipe, is
    written to directly. OSErrors name the path, even if a library wraps them in its own
    errors.
    """
    target = Path(os.path.realpath(path))
    with _naming(path):
        if target.exists() and not target.is_file():
            with target.open("wb") as direct:
                yield direct
            return
        mode = check_replaceable(target)
        new = _aside(target.parent)
        try:
            # Also readable: NumPy bypasses the buffer of a write-only file, and loses
            # errors of the disk.
            with new.open("x+b") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())  # raise errors before the old file is replaced
            if mode is not None:
                new.chmod(mode)
            os.replace(new, target)
        finally:
            new.unlink(missing_ok=True)


@contextlib.contextmanager
def files_together(folder: StrPath, *, removed: Iterable[str] = ()) -> Iterator[Path]:
    """Write files to a hidden folder, and move them to `folder` after the block.

    If the block fails, all old files stay. Otherwise files in `removed` are deleted.
    """
    folder = Path(folder)
    stage = _aside(folder)
    try:
        stage.mkdir()
        yield stage
        names = sorted(os.listdir(stage))
        gone = [name for name in removed if (folder / name).exists()]
        modes = {name: check_replaceable(folder / name) for name in (*names, *gone)}
        for name in names:
            if (mode := modes[name]) is not None:
                (stage / name).chmod(mode)
        for name in gone:
            (folder / name).unlink()
        for name in names:
            os.replace(stage / name, folder / name)
    except OSError as error:
        if str(error.filename).startswith(str(stage)):
            error.filename = f"{folder}{str(error.filename)[len(str(stage)) :]}"
            error.filename2 = None
        raise
    finally:
        shutil.rmtree(stage, ignore_errors=True)


@contextlib.contextmanager
def folder_for_writing(path: StrPath) -> Iterator[None]:
    """Make a folder and check that it can be written to; remove new ones on failure."""
    folder = Path(path)
    made = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        with _naming(path):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        yield
    except BaseException:
        for part in made:
            with contextlib.suppress(OSError):
                part.rmdir()
        raise


def check_replaceable(path: Path) -> int | None:
    """Return the permissions of a path, None if absent; raise if it is protected."""
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise OSError(errno.EINVAL, "is no plain file", os.fspath(path))
    if not path.exists():
        return None
    if not os.access(path, os.W_OK):
        raise OSError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))
    return path.stat().st_mode & 0o777


def _aside(folder: Path) -> Path:
    """Return a new hidden path in a folder."""
    return folder / f"{ASIDE}{uuid.uuid4().hex}"


@contextlib.contextmanager
def _naming(path: StrPath) -> Iterator[None]:
    """Raise the OSError that caused an error, if any, with the path in its message."""
    try:
        yield
    except Exception as error:
        of_disk: BaseException | None = error
        while not isinstance(of_disk, OSError):
            if of_disk is None:
                raise
            of_disk = of_disk.__cause__ or of_disk.__context__
        of_disk.filename, of_disk.filename2 = os.fspath(path), None
        if of_disk is error:
            raise
        raise of_disk from None
