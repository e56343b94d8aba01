"""Disks that fail, and processes that are stopped, at a chosen operation on a file."""

import builtins
import contextlib
import errno
import io
import os
from pathlib import Path

import pytest

# Operations that may fail, and those that clean up, during which one may be stopped.
WRITING = ("replace", "mkdir", "chmod", "fsync", "open")
CLEANING = ("unlink", "remove", "rmdir")


def disk_error(code):
    """Return what raises an error of the disk."""

    def strike(path=None):
        # As the system does: errors of open files do not say which file it is.
        named = [path] if isinstance(path, str | os.PathLike) else []
        raise OSError(code, os.strerror(code), *named)

    return strike


def interrupt(_path=None):
    """Do what Ctrl-C does."""
    raise KeyboardInterrupt


# By name: what happens instead of an operation, and at which later operations it
# happens again. A killed process does nothing more.
STRIKES = {
    "disk full": (disk_error(errno.ENOSPC), "writes"),
    "access denied": (disk_error(errno.EACCES), "none"),
    "interrupted": (interrupt, "none"),
    "killed": (interrupt, "all"),
}


class Faults:
    """What happens at one of the operations on files of a folder."""

    def __init__(self, folder, strike, at):
        self.folder = os.path.realpath(folder)
        self.strike, self.again = STRIKES[strike]
        self.at, self.operations = at, []

    def concerns(self, *paths, dir_fd=None, **_):
        """Tell whether an operation is on files of the folder."""
        named = [os.path.abspath(p) for p in paths if isinstance(p, str | os.PathLike)]
        return dir_fd is not None or any(p.startswith(self.folder) for p in named)

    def run(self, name, operation, *args, full=True, **keywords):
        """Run an operation, or let it fail."""
        self.operations.append((name, *map(str, args[:2])))
        number = len(self.operations)
        again = self.again == "all" or (self.again == "writes" and full)
        if number == self.at or (again and number > self.at):
            self.strike(*args[:1])
        return operation(*args, **keywords)


@contextlib.contextmanager
def disk_faults(folder, strike, at):
    """
    Let one operation on the files of a folder fail, or stop the process there.

    Operations are opening for writing, each write that reaches the disk, bringing to
    the disk, closing, renaming, linking, making folders and changing permissions; and
    removing, where the process is stopped. A write that fails has written a half.

    Parameters
    ----------
    folder : path-like
        The folder. Operations on files elsewhere are not counted.
    strike : str
        A key of `STRIKES`.
    at : int
        The number of the operation, from 1.

    Yields
    ------
    Faults
        With `operations`, which were tried.
    """
    faults = Faults(folder, strike, at)
    real_open = io.open

    class Raw(io.FileIO):
        """A file whose writes are counted."""

        def write(self, data):
            view = memoryview(data).cast("B")
            try:
                return faults.run("write", super().write, view)
            except OSError:
                super().write(view[: len(view) // 2])
                raise

        def close(self):
            if not self.closed:
                super().close()
                faults.run("close", lambda: None, full=False)

    def counting_open(file, mode="r", buffering=-1, *args, **keywords):
        """Open a file; one that is written to counts."""
        counts = set("wxa+") & set(mode) and faults.concerns(file)
        if not counts or "opener" in keywords:  # which calls os.open
            return real_open(file, mode, buffering, *args, **keywords)
        raw = faults.run("open", Raw, file, mode.replace("b", "").replace("t", ""))
        if "b" in mode and buffering == 0:
            return raw
        buffered = (io.BufferedRandom if "+" in mode else io.BufferedWriter)(raw)
        if "b" in mode:
            return buffered
        return io.TextIOWrapper(buffered, *args, **keywords)

    def counting(name):
        """Return an operation of the system that counts."""
        real = getattr(os, name)

        def operation(*args, **keywords):
            counts = name == "fsync" or faults.concerns(*args, **keywords)
            if name == "open":
                counts = counts and args[1] & (os.O_WRONLY | os.O_RDWR)
            if not counts:
                return real(*args, **keywords)
            full = name in ("open", "mkdir", "fsync")
            return faults.run(name, real, *args, full=full, **keywords)

        return operation

    with pytest.MonkeyPatch.context() as patch:
        for module in (io, builtins):
            patch.setattr(module, "open", counting_open)
        for name in WRITING + CLEANING * (faults.strike is interrupt):
            patch.setattr(os, name, counting(name))
        yield faults


def readable(folder):
    """Return what a reader finds in a folder: the contents of its files by their names.

    Hidden files and links that lead nowhere are not found.
    """
    found = {str(p.relative_to(folder)): p for p in Path(folder).rglob("*")}
    shown = {name: p for name, p in found.items() if "/." not in f"/{name}"}
    return {name: p.read_bytes() for name, p in shown.items() if p.is_file()}


def leftovers(folder):
    """Return the names of hidden files and of links in a folder."""
    found = [*Path(folder).rglob("*")]
    return [p.name for p in found if p.name.startswith(".") or p.is_symlink()]
