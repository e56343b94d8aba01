"""Run a command: its progress, messages of errors and warnings, and exit codes."""

import contextlib
import importlib
import io
import os
import shlex
import sys
import threading
import time
import warnings
from argparse import Namespace
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, TextIO

from isa_nrsfm._compat.texts import printable
from isa_nrsfm._parameters import WRITTEN, in_python
from isa_nrsfm.cli._options import NONE, PROGRAM, build_parser, flag_of


def run(argv: Sequence[str] | None = None) -> int:
    """Run the command line like `isa_nrsfm.cli.main`, which handles interruptions."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    started = Namespace(arguments=arguments, since=time.perf_counter())
    args = build_parser().parse_args(arguments, started)
    before = WRITTEN.set(partial(_as_option, args))
    try:
        with _warnings_as_lines() as warned, shown_progress(args.since):
            show_stage(args.command)
            # The module of a command is only loaded now: help does not wait.
            name = "_fit" if args.command in ("fit", "demo") else "_apply"
            module = importlib.import_module(f"isa_nrsfm.cli.{name}")
            report = getattr(module, f"run_{args.command}")(args, warned)
        encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
        report = printable(report)
        print(report.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except BrokenPipeError:
        _silence(sys.stdout)
        return 141
    except (ValueError, OSError, ImportError) as error:
        _say(f"error: {_message(error)}")
        return 1
    finally:
        WRITTEN.reset(before)
    return 0


@contextlib.contextmanager
def _warnings_as_lines() -> Iterator[list[str]]:
    """Show each warning once, as a line; yield the list of those shown."""
    warned: list[str] = []

    def show(message: Warning | str, *_: object, **__: object) -> None:
        text = " ".join(str(message).split())
        if text not in warned:
            warned.append(text)
            _say(f"warning: {text}")

    with warnings.catch_warnings(action="always"):
        for category in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", category)
        warnings.showwarning = show
        yield warned


def _message(error: Exception) -> str:
    """Return the message of an error, in one line."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def _as_option(args: Namespace, name: str, *values: Any) -> str:
    """Return a parameter of Python as an option of the command, if it is one."""
    if name == "kind":
        return f"--label COLUMN:{values[0]}"
    option = {"point_weight": "weights", "missing": "missing_value"}.get(name, name)
    if option not in args:
        return in_python(name, *values)
    sizes = ("x".join(map(str, v)) if isinstance(v, tuple) else v for v in values)
    values = tuple(f"{v:.15g}" if isinstance(v, float) else v for v in sizes)
    values = values if values != (True,) else ()
    texts = [shlex.quote(NONE if v is None else str(v)) for v in values]
    return f"{flag_of(option)} {' or '.join(texts)}".strip()


def _say(text: str) -> None:
    """Write a line to the standard error, if that is possible."""
    try:
        print(printable(f"{PROGRAM}: {text}"), file=sys.stderr, flush=True)
    except OSError:
        _silence(sys.stderr)


def _silence(stream: TextIO) -> None:
    """Write to nowhere from now on: Python flushes a stream once more at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


# Seconds between two lines: a twentieth of the time so far, within these limits. An
# hour has about 90 lines.
SHORTEST, LONGEST = 5.0, 60.0


def show_stage(text: str) -> None:
    """Name the stage that begins, for `shown_progress`."""
    print(text, end="\r", flush=True)


@contextlib.contextmanager
def shown_progress(since: float, shortest: float = SHORTEST) -> Iterator[None]:
    """Repeat the last printed line every few seconds on the standard error.

    Nothing of the block reaches the standard output. On a terminal whole lines are
    shown at once; those that end with a carriage return only in turn. Lines begin with
    the program's name and its time since `time.perf_counter` was `since`.
    """
    stream = sys.stderr
    latest = _LatestLine(stream if stream.isatty() else None)
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(min(max(_seconds(since) / 20, shortest), LONGEST)):
            with contextlib.suppress(OSError, ValueError):
                line = f"{PROGRAM}: {_seconds(since):.0f} s: {latest.line}"
                print(line, file=stream, flush=True)

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        with contextlib.redirect_stdout(latest):
            yield
    finally:
        ended.set()
        thread.join()


def _seconds(since: float) -> float:
    """Return the seconds since a time of `time.perf_counter`."""
    return time.perf_counter() - since


class _LatestLine(io.TextIOBase):
    """A stream that keeps its latest line, and passes whole lines on to a terminal."""

    def __init__(self, terminal: TextIO | None) -> None:
        self.terminal = terminal
        self.line = self.begun = ""

    def write(self, text: str) -> int:
        """Take a text that was printed."""
        for part in text.splitlines(keepends=True):
            self.begun += part
            if part.endswith(("\n", "\r")):
                if self.terminal is not None and part.endswith("\n"):
                    self.terminal.write(self.begun)
                    self.terminal.flush()
                self.line, self.begun = self.begun.strip() or self.line, ""
        return len(text)
