"""Files and folders that are written as a whole or not at all.

What is written goes to hidden files and folders whose names begin with `ASIDE`, in the
folder where it shall be, and is put in place by `os.replace`. A write that fails
removes them. Those of a process that was killed are removed by the next one that writes
into the folder: writers hold a lock of the folder (`flock`), so that the files of
others that still write are left alone. Systems without such locks keep the leftovers.
"""

import contextlib
import errno
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

ASIDE = ".isa-nrsfm-"

StrPath = str | os.PathLike[str]


def write_whole(path: StrPath, contents: bytes) -> None:
    """
    Write a file atomically: it has all of its new contents, or stays as it was.

    Parameters
    ----------
    path : str or path-like
        The file, as in `whole_file`.
    contents : bytes
        All that the file shall hold.

    Raises
    ------
    OSError
        If the file cannot be written; it is named.
    """
    with whole_file(path) as file:
        file.write(contents)


@contextlib.contextmanager
def whole_file(path: StrPath) -> Iterator[IO[bytes]]:
    """
    Open a file that has all of its new contents after the block, or stays as it was.

    The contents go to a new file in the same folder. That file gets the permissions of
    the old one and replaces it at the end of the block. A path that is no regular file,
    such as a pipe, is written to directly.

    Parameters
    ----------
    path : str or path-like
        The file; where it is a link, the file that it leads to.

    Yields
    ------
    file
        What to write to, in binary.

    Raises
    ------
    OSError
        If the file cannot be written, also where a library that writes to it hides the
        disk's error behind one of its own; the file is named.
    """
    target = Path(os.path.realpath(path))
    with _naming(path):
        if target.exists() and not target.is_file():
            with target.open("wb") as direct:
                yield direct
            return
        mode = _mode_to_keep(target)
        with _writing_in(target.parent):
            new = target.parent / _name_aside()
            try:
                # For reading, too: numpy writes around a file that is for writing only,
                # and then loses the disk's error.
                with new.open("x+b") as file:
                    yield file
                    _to_the_disk(file)
                if mode is not None:
                    new.chmod(mode)
                os.replace(new, target)
            finally:
                new.unlink(missing_ok=True)


@contextlib.contextmanager
def whole_folder(path: StrPath) -> Iterator[Path]:
    """
    Make a folder that appears with all of its files after the block, or not at all.

    Parameters
    ----------
    path : str or path-like
        The folder, which is new, in one that exists.

    Yields
    ------
    Path
        The folder to write the files to.

    Raises
    ------
    OSError
        If it cannot be made; it or its file is named.
    """
    target = Path(path)
    with _writing_in(target.parent):
        new = target.parent / _name_aside()
        try:
            with _renaming(new, target, 0):
                new.mkdir()
                yield new
                os.replace(new, target)
        finally:
            shutil.rmtree(new, ignore_errors=True)


@contextlib.contextmanager
def files_together(folder: StrPath, *, removed: Iterable[str] = ()) -> Iterator[Path]:
    """
    Write files that take the places of those of a folder together, or not at all.

    Where there are symbolic links, the places are exchanged in one step, so that who
    opens files of the folder finds all old ones or all new ones at any time, also after
    the process was killed: the files become links to the old ones, by a link to their
    folder, which is then replaced by one to the folder of the new ones; then the links
    become files again. Other files of the folder are not touched. Without symbolic
    links (Windows as it is set up, memory cards) the files are replaced one by one, and
    an error brings back those that were.

    Parameters
    ----------
    folder : str or path-like
        The folder, which exists.
    removed : iterable of str
        Names of files of the folder that go when the new ones come.

    Yields
    ------
    Path
        The folder to write the new files to.

    Raises
    ------
    OSError
        If a file cannot be written or put in place; it is named.
    """
    folder = Path(folder)
    with _writing_in(folder, alone=True):
        stage = folder / _name_aside()
        try:
            with _renaming(stage, folder, 1):
                for part in (stage, stage / "new"):
                    part.mkdir()
                yield stage / "new"
                _exchange(stage, folder, removed)
        finally:
            try:
                _clear(stage)
            except BaseException as error:
                _clear(stage)
                if not isinstance(error, OSError):
                    raise


@contextlib.contextmanager
def folder_for_writing(path: StrPath) -> Iterator[None]:
    """
    Make a folder, and check that it can be written to; remove it if the block fails.

    What killed processes have left in the folder is removed.

    Parameters
    ----------
    path : str or path-like
        The folder. One that exists is kept, as is one that has files after the block.

    Raises
    ------
    OSError
        If it cannot be made or written to; it is named.
    """
    folder = Path(path)
    made = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        with _naming(path):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        with _writing_in(folder):
            pass
        yield
    except BaseException:
        for part in made:
            with contextlib.suppress(OSError):
                part.rmdir()
        raise


def refuse_replacing(path: Path) -> None:
    """
    Raise if `files_together` would not replace a file.

    Parameters
    ----------
    path : Path
        The file. It need not exist.

    Raises
    ------
    OSError
        If it is a folder or a link, or protected from being written to.
    """
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise OSError(errno.EINVAL, "is no plain file", os.fspath(path))
    _mode_to_keep(path)


def _exchange(stage: Path, folder: Path, removed: Iterable[str]) -> None:
    """Put the new files of a stage in the places of the old ones of its folder."""
    new, old, links = (stage / part for part in ("new", "old", "links"))
    old.mkdir()
    names = [file.name for file in sorted(new.iterdir())]
    gone = [name for name in removed if (folder / name).exists()]
    for name in (*names, *gone):
        with _naming(folder / name):
            refuse_replacing(folder / name)
            mode = _mode_to_keep(folder / name)
            if mode is None:
                continue
            try:
                os.link(folder / name, old / name)
            except OSError:
                shutil.copy2(folder / name, old / name)
            if name not in gone:
                (new / name).chmod(mode)
    try:
        links.mkdir()
        (stage / "current").symlink_to("old", target_is_directory=True)
        (stage / "next").symlink_to("new", target_is_directory=True)
        for name in (*names, *gone):
            (links / name).symlink_to(Path(stage.name, "current", name))
    except (OSError, NotImplementedError):
        _replace_one_by_one(stage, folder, names, gone)
        return
    for name in (*names, *gone):
        with _naming(folder / name):
            os.replace(links / name, folder / name)
    with _naming(folder):
        os.replace(stage / "next", stage / "current")


def _replace_one_by_one(
    stage: Path, folder: Path, names: list[str], gone: list[str]
) -> None:
    """Put the new files in place, or bring the old ones back."""
    new, old = stage / "new", stage / "old"
    try:
        for name in names:
            with _naming(folder / name):
                os.replace(new / name, folder / name)
        for name in gone:
            with _naming(folder / name):
                (folder / name).unlink()
    except BaseException:
        for name in (*names, *gone):
            if (old / name).exists():
                os.replace(old / name, folder / name)
            elif not (new / name).exists():
                (folder / name).unlink(missing_ok=True)
        raise


def _clear(stage: Path) -> None:
    """Put the files in place that links into a stage lead to, and remove the stage."""
    if not stage.is_dir():
        stage.unlink(missing_ok=True)
        return
    for place in [stage.parent / name for name in os.listdir(stage.parent)]:
        if place.is_symlink() and Path(os.readlink(place)).parts[0] == stage.name:
            led_to = stage / "current" / place.name
            if led_to.exists():
                os.replace(led_to, place)
            else:
                place.unlink()
    shutil.rmtree(stage, ignore_errors=True)


@contextlib.contextmanager
def _writing_in(folder: Path, *, alone: bool = False) -> Iterator[None]:
    """Hold a lock of a folder, and remove what killed processes have left there.

    Several writers may hold it, or one that is alone.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            lock = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, lock)
            with contextlib.suppress(BlockingIOError):
                wait = 0 if alone else fcntl.LOCK_NB
                fcntl.flock(lock, fcntl.LOCK_EX | wait)
                for name in os.listdir(folder):
                    if name.startswith(ASIDE):
                        with contextlib.suppress(OSError):
                            _clear(folder / name)
            if not alone:
                fcntl.flock(lock, fcntl.LOCK_SH)
        yield


def _name_aside() -> str:
    """Return a name that nothing else has."""
    return f"{ASIDE}{uuid.uuid4().hex}"


def _mode_to_keep(path: Path) -> int | None:
    """Return the permissions of a file that is to be replaced, None if there is none.

    A file that its owner has protected from being written to is not replaced.
    """
    if not path.exists():
        return None
    if not os.access(path, os.W_OK):
        raise OSError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))
    return path.stat().st_mode & 0o777


def _to_the_disk(file: IO[bytes]) -> None:
    """Write what is still in memory: errors come now, and not when it is too late."""
    file.flush()
    os.fsync(file.fileno())


@contextlib.contextmanager
def _naming(path: StrPath) -> Iterator[None]:
    """Name a file in errors of the disk, in place of what was written aside."""
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


@contextlib.contextmanager
def _renaming(aside: Path, target: Path, depth: int) -> Iterator[None]:
    """Name the place in errors of the disk that name what lies aside, so deep in it."""
    try:
        yield
    except OSError as error:
        with contextlib.suppress(ValueError, TypeError):  # another file, a number
            named = aside if error.filename is None else Path(error.filename)
            inside = named.relative_to(aside).parts[depth:]
            error.filename = os.fspath(target.joinpath(*inside))
            error.filename2 = None
        raise
