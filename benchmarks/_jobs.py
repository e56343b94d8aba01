"""What is run, and running it: each job in a process of its own, some at a time."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from typing import NamedTuple

from benchmarks._isolated import Outcome, run_isolated
from benchmarks._results import Record


class Job(NamedTuple):
    """
    One run.

    Attributes
    ----------
    section, set, method : str
        What is measured, on what, of what.
    seed : int
        Random seed.
    function : callable
        Returns the figures by name, and arrays for pictures by name, as two dicts. Its
        first argument is the context manager of `run_isolated`.
    arguments : dict
        Its other arguments.
    parameters : dict
        What else distinguishes the run, for its record.
    """

    section: str
    set: str
    method: str
    seed: int
    function: Callable
    arguments: dict
    parameters: dict


class Limits(NamedTuple):
    """
    What a run may use.

    Attributes
    ----------
    time : float
        Seconds of what is measured.
    memory : float or None
        Gigabytes.
    threads : int
        Threads of the linear algebra library.
    """

    time: float
    memory: float | None
    threads: int


def run_jobs(jobs, limits, n_at_a_time, environment):
    """
    Run jobs, and yield the record and the arrays of each as it ends.

    A job is not run where another one of its section, set, method and parameters has
    taken too long before: it has the same record.

    Parameters
    ----------
    jobs : list of Job
        In the order in which they are begun.
    limits : Limits
        Of each.
    n_at_a_time : int
        How many run at a time.
    environment : str
        For the records.

    Yields
    ------
    record : Record
        What became of a job.
    arrays : dict
        Arrays for pictures; empty unless it succeeded.
    """
    slow = {}
    with ThreadPoolExecutor(n_at_a_time) as pool:
        futures = [
            pool.submit(partial(_run, job, limits, environment, slow)) for job in jobs
        ]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _run(job, limits, environment, slow):
    """Return the record and the arrays of a job."""
    key = (job.section, job.set, job.method, *sorted(job.parameters.items()))
    outcome = slow.get(key) or run_isolated(
        job.function,
        job.arguments,
        time_limit=limits.time,
        memory_limit=limits.memory,
        threads=limits.threads,
    )
    if outcome.status == "over time":
        slow[key] = outcome
    return _record(job, outcome, environment)


def _record(job: Job, outcome: Outcome, environment):
    """Return the record and the arrays of what became of a job."""
    values, arrays = outcome.values or ({}, {})
    record = Record(
        section=job.section,
        set=job.set,
        method=job.method,
        seed=job.seed,
        status=outcome.status,
        values=values,
        parameters=job.parameters,
        seconds=outcome.seconds,
        memory=outcome.memory,
        message=outcome.message,
        warnings=outcome.warnings,
        environment=environment,
    )
    return record, arrays
