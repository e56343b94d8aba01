"""Run a command, and turn what can go wrong into messages and exit codes."""

import contextlib
import os
import re
import sys
import time
import warnings
from argparse import Namespace
from collections.abc import Iterator, Sequence
from functools import partial
from typing import TextIO

from isa_nrsfm.cli._parser import PROGRAM, build_parser
from isa_nrsfm.cli._progress import show_stage, shown_progress

FINE, BAD_INPUT, BROKEN_PIPE = 0, 1, 141
# Parameters that messages name, as options of the same names.
_PARAMETERS = ("n_components", "camera", "refinement", "independence", "loss")


def run(argv: Sequence[str] | None = None) -> int:
    """Run the command line as of `isa_nrsfm.cli.main`, but for interruptions."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    started = Namespace(arguments=arguments, since=time.perf_counter())
    args = build_parser().parse_args(arguments, started)
    try:
        with _warnings_as_lines(args) as warned, shown_progress(PROGRAM, args.since):
            show_stage(args.command)
            report = _run(args, warned)
        _show(report)
    except BrokenPipeError:
        # Python flushes the standard output once more at exit.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (ValueError, OSError, ImportError) as error:
        _say(f"error: {_message(error, args)}")
        return BAD_INPUT
    return FINE


def _run(args: Namespace, warned: list[str]) -> str:
    """Run the command and return its report."""
    # What only a command needs is loaded only for a command, not for help.
    if args.command == "demo":
        from isa_nrsfm.cli._demo import run_demo

        return run_demo(args, warned)
    if args.command == "export":
        from isa_nrsfm.cli._export import run_export

        return run_export(args)
    if args.command == "transform":
        from isa_nrsfm.cli._transform import run_transform

        return run_transform(args)
    from isa_nrsfm.cli._commands import run_fit

    return run_fit(args, warned)


@contextlib.contextmanager
def _warnings_as_lines(args: Namespace) -> Iterator[list[str]]:
    """Show each warning once, as a line; yield the list of those shown."""
    warned: list[str] = []

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        text = _with_options(str(message), args)
        if text not in warned:
            warned.append(text)
            _say(f"warning: {text}")

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        for category in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", category)
        warnings.showwarning = show
        yield warned


def _message(error: Exception, args: Namespace) -> str:
    """Return what an error says, in one line."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return _with_options(str(error), args) or type(error).__name__


def _with_options(text: str, args: Namespace) -> str:
    """Join the lines of a message, and name options instead of parameters of Python."""
    text = " ".join(text.split())
    for name in filter(partial(hasattr, args), _PARAMETERS):
        option = f"--{name.replace('_', '-')}"
        value = r"=(?P<quote>['\"]?)(?P<value>[\w.-]*\w)(?P=quote)"
        text = re.sub(rf"(?<![\w/\\-]){name}{value}", rf"{option} \g<value>", text)
    if hasattr(args, "n_components"):
        text = re.sub(r"(?<![\w'\"-])n_components\b", "--n-components", text)
    return text


def _show(report: str) -> None:
    """Write the report to the standard output, in whatever encoding that has.

    It is written after the results: a name that the encoding lacks is no error.
    """
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    print(report.encode(encoding, "backslashreplace").decode(encoding), flush=True)


def _say(text: str) -> None:
    """Write a line to the standard error."""
    print(f"{PROGRAM}: {text}", file=sys.stderr, flush=True)
