"""What the benchmarks' command lines have in common."""

import argparse
import time
import warnings

from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits


def run(title, sections, n_seeds, options=None):
    """
    Run the sections that the command line names.

    Parameters
    ----------
    title : str
        What is measured.
    sections : dict of functions
        Each takes the parsed options and prints its figures; the first line of its
        docstring is the heading.
    n_seeds : int
        Default of ``--seeds``.
    options : dict, default=None
        More options: keyword arguments of ``add_argument`` by name.
    """
    names = ", ".join(sections)
    parser = argparse.ArgumentParser(description=title, epilog=f"sections: {names}")
    parser.add_argument(
        "sections", nargs="*", metavar="section", help="what to run; all by default"
    )
    parser.add_argument(
        "--seeds", type=int, default=n_seeds, help="random seeds (default %(default)s)"
    )
    for name, keywords in (options or {}).items():
        parser.add_argument(f"--{name}", **keywords)
    chosen = parser.parse_args()
    unknown = sorted(set(chosen.sections) - set(sections))
    if unknown:
        parser.error(f"no section {', '.join(unknown)}; there are {names}")
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore", ConvergenceWarning)
        for name in chosen.sections or sections:
            function = sections[name]
            print(f"\n[{name}] {function.__doc__.splitlines()[0]}", flush=True)
            since = time.perf_counter()
            function(chosen)
            print(f"({time.perf_counter() - since:.0f} s)", flush=True)
