"""Run functions: in a process of its own with a time limit, or from a command line."""

import argparse
import multiprocessing
import resource
import signal
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

DIGITS = 6  # that are kept of each number


def run_isolated(function, arguments, time_limit):
    """
    Call a function in a new process, with one thread of linear algebra.

    Parameters
    ----------
    function : callable
        Defined in a module; returns figures by name. Its first argument is a context
        manager, `measured`: what runs in ``with measured():`` is timed, each time, and
        must end within the time limit.
    arguments : dict
        Its keyword arguments.
    time_limit : float
        Seconds.

    Returns
    -------
    dict
        `status` ("ok", "over time", "error"), `values`, and `message` if it failed;
        `seconds` of what was measured, `memory`, by how many megabytes what the process
        has in use rose at most.
    """
    # A fork would share the memory of this process, and the state of its libraries.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as pool:
        try:
            return pool.submit(_call, function, arguments, time_limit).result()
        except TimeoutError:
            return _failed("over time", f"over {time_limit:g} s")
        except Exception as error:
            line = " ".join(f"{type(error).__name__}: {error}".split())
            return _failed("error", line.removesuffix(":"))


def _failed(status, message):
    """Return what is known of a call that failed."""
    nothing = {"values": {}, "seconds": None, "memory": None}
    return {"status": status, **nothing, "message": message}


def _call(function, arguments, time_limit):
    """Call a function in this process, and return what `run_isolated` returns."""
    seconds, memory = [], []

    def end(*_):
        raise TimeoutError

    @contextmanager
    def measured():
        before, since = peak_memory(), time.perf_counter()
        signal.setitimer(signal.ITIMER_REAL, time_limit)
        yield
        signal.setitimer(signal.ITIMER_REAL, 0)
        seconds.append(time.perf_counter() - since)
        memory.append(peak_memory(reset=False) - before)

    signal.signal(signal.SIGALRM, end)
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore")
        values = function(measured, **arguments)
    return {
        "status": "ok",
        "values": values,
        "seconds": sum(seconds),
        "memory": max(memory),
        "message": "",
    }


def peak_memory(reset=True):
    """Return the most memory that this process has had in use, in megabytes.

    After a reset, if it is allowed, this is what is in use now.
    """
    # Only Linux has these files: elsewhere the peak is that since the start, in bytes
    # on macOS. Unlike ru_maxrss, it does not include the process that started this one.
    process = Path("/proc/self")
    if not process.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    if reset:
        with suppress(OSError):  # where it is not allowed
            (process / "clear_refs").write_text("5")
    kilobytes = (process / "status").read_text().partition("VmHWM:")[2].split()[0]
    return int(kilobytes) * 1024 / 1e6


def rounded(value):
    """Return numbers with a few significant digits, None where not finite."""
    if isinstance(value, list | np.ndarray):
        return [rounded(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def run_sections(title, sections, n_seeds=1, **options):
    """
    Run the sections that the command line names.

    Parameters
    ----------
    title : str
        What is measured.
    sections : dict of functions
        Each takes the parsed options and prints its figures; the first line of its
        docstring is the heading.
    n_seeds : int, default=1
        Default of ``--seeds``.
    **options : dict
        More options: keyword arguments of ``add_argument`` by name.
    """
    names = ", ".join(sections)
    parser = argparse.ArgumentParser(description=title, epilog=f"sections: {names}")
    parser.add_argument(
        "sections", nargs="*", metavar="section", help="what to run; all by default"
    )
    options["seeds"] = {
        "type": int,
        "default": n_seeds,
        "help": "random seeds (default %(default)s)",
    }
    for name, keywords in options.items():
        parser.add_argument(f"--{name}", **keywords)
    chosen = parser.parse_args()
    if unknown := sorted(set(chosen.sections) - set(sections)):
        parser.error(f"no section {', '.join(unknown)}; there are {names}")
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore", ConvergenceWarning)
        for name in chosen.sections or sections:
            function = sections[name]
            print(f"\n[{name}] {function.__doc__.splitlines()[0]}", flush=True)
            since = time.perf_counter()
            function(chosen)
            print(f"({time.perf_counter() - since:.0f} s)", flush=True)


def every_seed(sets, methods, repeats):
    """Return set, method, seed and no parameters of a run of each with each seed."""
    return [(*names, {}) for names in product(sets, methods, range(repeats))]


class Section(NamedTuple):
    """
    A section of the comparison.

    Attributes
    ----------
    title : str
        Heading of its page.
    measure : callable
        Takes `measured` of `run_isolated`, set, method, seed and parameters of a run;
        returns its figures by name.
    page : callable
        Returns the page of records, in markdown.
    sets, methods : tuple of str
        What is measured, and of what, unless something else is chosen.
    other_sets, other_methods : tuple of str
        What can be chosen, too.
    draw : callable or None
        Draws pictures of records to a folder, and returns the names of the files.
    runs : callable
        Returns set, method, seed and parameters of each run, for sets, methods and the
        number of seeds.
    """

    title: str
    measure: Callable
    page: Callable
    sets: tuple[str, ...]
    methods: tuple[str, ...]
    other_sets: tuple[str, ...] = ()
    other_methods: tuple[str, ...] = ()
    draw: Callable | None = None
    runs: Callable = every_seed
