"""Run a command, and turn errors and warnings into messages and exit codes."""

import contextlib
import importlib
import os
import shlex
import sys
import time
import warnings
from argparse import Namespace
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, TextIO

from isa_nrsfm._compat.texts import printable
from isa_nrsfm._parameters import WRITTEN, in_python
from isa_nrsfm.cli._options import NONE, PROGRAM, build_parser, flag_of
from isa_nrsfm.cli._progress import show_stage, shown_progress


def run(argv: Sequence[str] | None = None) -> int:
    """Run the command line like `isa_nrsfm.cli.main`, which handles interruptions."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    started = Namespace(arguments=arguments, since=time.perf_counter())
    args = build_parser().parse_args(arguments, started)
    before = WRITTEN.set(partial(_as_option, args))
    try:
        with _warnings_as_lines() as warned, shown_progress(args.since):
            show_stage(args.command)
            # Each command is a module, which is only loaded now: help does not wait.
            command = importlib.import_module(f"isa_nrsfm.cli._{args.command}")
            report = command.run(args, warned)
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
    if getattr(args, option, args) is args:
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
