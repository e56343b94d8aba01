"""Progress of a command, on the standard error."""

import contextlib
import io
import sys
import threading
import time
from collections.abc import Iterator
from typing import TextIO

from isa_nrsfm.cli._options import PROGRAM

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
