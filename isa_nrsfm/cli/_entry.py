"""The entry of the program: nearly all imports are inside it."""

import os
import signal
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

# Signals after which hidden files and new empty folders are removed.
STOPPING = ("SIGTERM", "SIGHUP")


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    The report goes to the standard output; errors, warnings and the progress go to the
    standard error. Characters that the encoding of the standard output lacks are
    written with a backslash.

    Parameters
    ----------
    argv : sequence of str, optional
        The arguments. By default the arguments of the process.

    Returns
    -------
    int
        The exit code: 0 if all went well, 1 if the table, the model or another input
        is bad, 130 if interrupted, 141 if the reader of the output has gone.

    Raises
    ------
    SystemExit
        With code 2 if the arguments are wrong, with 0 after ``--help`` and
        ``--version``, with 143 or 129 if the process is stopped by SIGTERM or SIGHUP.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed, as in services
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
    codes: list[int] = []

    def stop(number: int, _frame: Any) -> NoReturn:
        """End the process as shells report its signal."""
        codes.append(128 + number)
        raise SystemExit(codes[0])

    if argv is None:  # the process is this program
        for number in filter(None, (getattr(signal, n, None) for n in STOPPING)):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, stop)
    try:
        # Within the try block: an interruption may come while modules are imported.
        from isa_nrsfm.cli._main import run

        code = run(argv)
        # Code in C may lose the exception of a signal, and fail for the lack of it.
        return codes[0] if code and codes else code
    except KeyboardInterrupt:
        print("isa-nrsfm: interrupted", file=sys.stderr, flush=True)
        return 130
