"""Run a function in a process of its own, with limits, and say what became of it.

What a method needs is measured in a fresh process: its seconds, its peak of memory.
Nothing that it does, be it an error, a crash or a run without end, reaches the caller.
"""

import multiprocessing
import resource
import time
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from threadpoolctl import threadpool_limits

# Seconds that a process may take before and after what is measured, if the time limit
# is shorter: to start, and to read and judge large tables.
LEAST_PATIENCE = 300.0
LONGEST_WARNING = 200  # characters


class Outcome(NamedTuple):
    """
    What became of a run.

    Attributes
    ----------
    status : {"ok", "over time", "error"}
        Whether the function returned, what is measured took longer than the limit, or
        anything else happened.
    values : object
        What the function returned; None if it did not.
    seconds : float or None
        Seconds of what was measured, None if it was not completed.
    memory : float or None
        By how much memory in use rose at most while it ran, in megabytes.
    message : str
        The error, in one line.
    warnings : sequence of str
        Warnings that were issued, each once.
    """

    status: str
    values: object = None
    seconds: float | None = None
    memory: float | None = None
    message: str = ""
    warnings: tuple = ()


def run_isolated(
    function: Callable,
    arguments: dict,
    *,
    time_limit: float,
    memory_limit: float | None = None,
    threads: int = 1,
) -> Outcome:
    """
    Call a function in a new process.

    Parameters
    ----------
    function : callable
        Defined in a module. Its first argument is a context manager, `measured`: what
        runs in ``with measured():`` is timed and must end within the time limit. Where
        this is used several times seconds are added up.
    arguments : dict
        Its keyword arguments.
    time_limit : float
        Seconds after which what is measured is killed, each time.
    memory_limit : float, default=None
        Gigabytes of address space that the process may have.
    threads : int, default=1
        Threads of the linear algebra library.

    Returns
    -------
    Outcome
        What became of it.
    """
    # A fork would share the memory of this process, and the state of its libraries.
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(
        target=_serve, args=(sender, function, arguments, memory_limit, threads)
    )
    process.start()
    sender.close()
    try:
        return _listen(process, receiver, time_limit)
    finally:
        process.kill()
        process.join()
        receiver.close()


def _listen(process, receiver, time_limit: float) -> Outcome:
    """Return what a process reports, or does not report in time."""
    patience = max(time_limit, LEAST_PATIENCE)
    seconds = memory = None
    measuring = False
    while receiver.poll(time_limit if measuring else patience):
        try:
            kind, *content = receiver.recv()
        except EOFError:
            process.join()
            message = f"the process ended with exit code {process.exitcode}"
            return Outcome("error", None, seconds, memory, message)
        if kind == "measuring":
            measuring = True
        elif kind == "measured":
            measuring = False
            seconds = content[0] + (seconds or 0.0)
            memory = max(content[1], memory or 0.0)
        elif kind == "returned":
            return Outcome("ok", content[0], seconds, memory, "", content[1])
        else:
            return Outcome("error", None, seconds, memory, *content)
    if measuring:
        return Outcome("over time", message=f"over {time_limit:g} s")
    message = f"reading and judging took over {patience:g} s"
    return Outcome("error", None, seconds, memory, message)


def _serve(sender, function: Callable, arguments: dict, memory_limit, threads) -> None:
    """Call the function, in the new process, and report to the one that waits."""

    @contextmanager
    def measured():
        before = reset_peak_memory()
        sender.send(("measuring",))
        since = time.perf_counter()
        yield
        seconds = time.perf_counter() - since
        sender.send(("measured", seconds, _peak_memory() - before))

    if memory_limit is not None:
        n_bytes = int(memory_limit * 1e9)
        resource.setrlimit(resource.RLIMIT_AS, (n_bytes, n_bytes))
    with warnings.catch_warnings(record=True) as caught, threadpool_limits(threads):
        warnings.simplefilter("always")
        try:
            report = ("returned", function(measured, **arguments))
        except Exception as error:
            line = " ".join(str(error).split())
            report = ("failed", f"{type(error).__name__}: {line}".removesuffix(": "))
    texts = [f"{w.category.__name__}: {w.message}"[:LONGEST_WARNING] for w in caught]
    sender.send((*report, list(dict.fromkeys(texts))))


def reset_peak_memory() -> float:
    """Return the peak of this process, after lowering it to what it uses if allowed."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass  # only Linux has it: elsewhere the peak is that since the start
    return _peak_memory()


def _peak_memory() -> float:
    """Return the most memory that this process has had in use, in megabytes."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        # In bytes on macOS; the others have /proc.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    # Unlike ru_maxrss it does not include the process that has started this one.
    kilobytes = status.partition("VmHWM:")[2].split()[0]
    return int(kilobytes) * 1024 / 1e6
