"""Run a command, and turn errors and warnings into messages and exit codes."""

import contextlib
import importlib
import os
import re
import sys
import time
import warnings
from argparse import Namespace
from collections.abc import Iterator, Sequence
from functools import partial
from typing import TextIO

from isa_nrsfm._compat.texts import printable
from isa_nrsfm.cli._options import NONE, PROGRAM, build_parser, flag_of
from isa_nrsfm.cli._progress import show_stage, shown_progress

# Parameters that messages name, as options of the same names.
_PARAMETERS = ("n_components", "camera", "refinement", "independence", "loss")


def run(argv: Sequence[str] | None = None) -> int:
    """Run the command line like `isa_nrsfm.cli.main`, which handles interruptions."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    started = Namespace(arguments=arguments, since=time.perf_counter())
    args = build_parser().parse_args(arguments, started)
    try:
        with _warnings_as_lines(args) as warned, shown_progress(args.since):
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
        _say(f"error: {_message(error, args)}")
        return 1
    return 0


@contextlib.contextmanager
def _warnings_as_lines(args: Namespace) -> Iterator[list[str]]:
    """Show each warning once, as a line; yield the list of those shown."""
    warned: list[str] = []

    def show(message: Warning | str, *_: object, **__: object) -> None:
        text = _with_options(str(message), args)
        if text not in warned:
            warned.append(text)
            _say(f"warning: {text}")

    with warnings.catch_warnings(action="always"):
        for category in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", category)
        warnings.showwarning = show
        yield warned


def _message(error: Exception, args: Namespace) -> str:
    """Return the message of an error, in one line."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return _with_options(str(error), args) or type(error).__name__


def _with_options(text: str, args: Namespace) -> str:
    """Join the lines of a message, and name options instead of parameters of Python."""
    text = " ".join(text.split())
    for name in filter(partial(hasattr, args), _PARAMETERS):
        text = text.replace(f"{name}=None", f"{name}={NONE}")
        value = r"=(?P<quote>['\"]?)(?P<value>[\w.-]*\w)(?P=quote)"
        option = rf"{flag_of(name)} \g<value>"
        text = re.sub(rf"(?<![\w/\\-]){name}{value}", option, text)
    if hasattr(args, "n_components"):
        text = re.sub(r"(?<![\w'\"-])n_components\b", "--n-components", text)
    return text


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
