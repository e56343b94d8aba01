"""Break the core in random places, and count how often the tests notice.

    python -m benchmarks.mutation --places 200 --seed 0 --layer quick

Each place is a sign, a comparison, a bound, an index, a factor, a term, ... of one
line (`_mutants`). The broken module is written into a copy of the checkout, where the
tests run that cover the line, as many of the fastest as CPU seconds allow: file by
file, the cheapest first, until one fails. Which tests cover a line, and how long they
take, is recorded first (pytest-cov), once for each state of the package and its tests.

A change that survives is not one that the tests must notice: it may change nothing, or
only the number of steps.
"""

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from benchmarks._mutants import Mutant, mutants
from benchmarks._mutation_plugin import CHOSEN, SECONDS

ROOT = Path(__file__).resolve().parents[1]
CORE = ("isa_nrsfm/_*/**/*.py", "isa_nrsfm/_*.py", "isa_nrsfm/isa/*.py")
# A changed line need not be formatted, and pages in browsers take too long.
LAYERS = {"quick": [], "full": ["-m", "not (lint or browser or cluster)"]}
PYTEST = [sys.executable, "-m", "pytest", "-p", "benchmarks._mutation_plugin", "-q"]
UNTIL_ONE_FAILS = ["-x", "--tb=no", "-p", "no:cacheprovider"]
WRONG_USAGE, NO_TESTS = 4, 5  # exit codes: the map is not of these tests
STARTUP = 60.0  # CPU seconds for imports and the collection of tests
SLOWER = 5.0  # how much longer than at first tests may take, whatever else runs
NOT_COPIED = (".git", ".hypothesis", "__pycache__", ".*_cache", "docs")


class Coverage(NamedTuple):
    """
    What the tests of a layer that pass cover.

    Attributes
    ----------
    lines : dict
        By module and line, as ``"module:line"``, the places of the tests that run it.
    modules : dict
        By module those that run any function of it: for lines that run at import.
    seconds : dict
        By test, its CPU seconds, in the order in which they ran: their places.
    """

    lines: dict
    modules: dict
    seconds: dict

    def tests_of(self, mutant: Mutant):
        """Return the tests that cover a line, the cheapest files first."""
        first, last = mutant.lines
        covering = {
            place
            for line in range(first, last + 1)
            for place in self.lines.get(f"{mutant.file}:{line}", ())
        }
        if not mutant.in_function:
            covering |= set(self.modules.get(mutant.file, ()))
        files = defaultdict(list)
        for place, test in enumerate(self.seconds):  # in order: fixtures are kept
            if place in covering:
                files[test.partition("::")[0]].append(test)
        return [
            test
            for file in sorted(files.values(), key=self.total)
            for test in sorted(file, key=self._is_long)
        ]

    def total(self, tests) -> float:
        """Return the seconds of tests."""
        return sum(self.seconds[test] for test in tests)

    def _is_long(self, test: str) -> bool:
        return self.seconds[test] > 1.0


class Verdict(NamedTuple):
    """
    What became of a mutant.

    Attributes
    ----------
    status : {"killed", "survived", "not covered"}
        Whether a test failed.
    by : str
        The test, or what ended it.
    n_tests, n_covering : int
        How many tests were chosen of those that cover the line.
    seconds : float
        CPU seconds.
    """

    status: str
    by: str
    n_tests: int
    n_covering: int
    seconds: float


def environment(root: Path, **others) -> dict:
    """Return the environment for tests of a copy."""
    return os.environ | {"PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1"} | others


def digest() -> str:
    """Return a short name for the state of the package and its tests."""
    files = sorted([*ROOT.glob("isa_nrsfm/**/*.py"), *ROOT.glob("tests/*.py")])
    content = b"".join(path.read_bytes() for path in files)
    return hashlib.sha256(content).hexdigest()[:12]


def record(layer: str, jobs: int) -> Coverage:
    """Run the tests of a layer once, and return what they cover."""
    from coverage import CoverageData

    with tempfile.TemporaryDirectory() as folder:
        copy = copy_of_checkout(Path(folder, "copy"))
        seconds = Path(folder, "seconds")
        seconds.mkdir()
        command = [
            *PYTEST,
            *LAYERS[layer],
            *("-n", str(jobs), "--dist", "loadfile"),
            *("--cov=isa_nrsfm", "--cov-context=test", "--cov-report="),
        ]
        done = subprocess.run(
            command,
            cwd=copy,
            env=environment(copy, **{SECONDS: str(seconds)}),
            stdout=subprocess.DEVNULL,
        )
        if done.returncode > 1:
            raise SystemExit("the tests of the layer did not run")
        if done.returncode:
            print("some tests fail without any change: they are left out")
        took = [
            json.loads(line)
            for file in sorted(seconds.iterdir())
            for line in file.read_text().splitlines()
        ]
        data = CoverageData(str(copy / ".coverage"))
        data.read()
        return coverage_of(data, copy, dict(took))


def coverage_of(data, root: Path, seconds: dict) -> Coverage:
    """Return the tests by line of the measured files below a folder."""
    lines, modules = {}, defaultdict(set)
    places = {test: place for place, test in enumerate(seconds)}
    for path in data.measured_files():
        name = Path(path).relative_to(root).as_posix()
        for line, contexts in data.contexts_by_lineno(path).items():
            # A context is a test and its phase.
            tests = {each.rpartition("|")[0] for each in contexts}
            if found := [places[test] for test in tests if test in places]:
                lines[f"{name}:{line}"] = sorted(found)
                modules[name].update(found)
    return Coverage(lines, {n: sorted(t) for n, t in modules.items()}, seconds)


def recorded(path: Path, layer: str, jobs: int) -> Coverage:
    """Return what is recorded in a file, or record it."""
    if not path.exists():
        print(f"recording what the {layer} layer covers, into {path}", flush=True)
        path.write_text(json.dumps(record(layer, jobs)._asdict()))
    return Coverage(**json.loads(path.read_text()))


def copy_of_checkout(folder: Path) -> Path:
    """Copy what the tests need, and return the folder."""
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*NOT_COPIED))
    return folder


def places(n_places: int, seed: int) -> list[Mutant]:
    """Return random mutants of the core, each of another place where possible."""
    found = [
        mutant
        for pattern in CORE
        for path in sorted(ROOT.glob(pattern))
        for mutant in mutants(path.relative_to(ROOT).as_posix(), path.read_text())
    ]
    found = sorted(set(found))
    random.Random(seed).shuffle(found)
    return found[:n_places]


def judge(mutant: Mutant, copy: Path, coverage: Coverage, layer, most, number: int):
    """Return the verdict of the tests on a mutant."""
    covering = coverage.tests_of(mutant)
    cheapest, cost = set(), 0.0
    for test in sorted(covering, key=coverage.seconds.get):
        cost += coverage.seconds[test]
        if not cheapest or cost <= most:
            cheapest.add(test)
    chosen = [test for test in covering if test in cheapest]
    if not chosen:
        return Verdict("not covered", "", 0, 0, 0.0)
    path, seconds = copy / mutant.file, 0.0
    original = path.read_text()
    path.write_text(mutant.text)
    # What was compiled before is told from this by its time, in whole seconds.
    os.utime(path, (1e9 + number, 1e9 + number))
    try:
        for tests in in_two_parts(chosen):
            by, used = run(tests, copy, layer, STARTUP + SLOWER * coverage.total(tests))
            seconds += used
            if by:
                return Verdict("killed", by, len(chosen), len(covering), seconds)
    finally:
        path.write_text(original)
    return Verdict("survived", "", len(chosen), len(covering), seconds)


def in_two_parts(tests: list[str]) -> list[list[str]]:
    """Return the tests of the first two files, which are soon collected, and others."""
    files = list(dict.fromkeys(test.partition("::")[0] for test in tests))
    first = [test for test in tests if test.partition("::")[0] in files[:2]]
    others = [test for test in tests if test.partition("::")[0] not in files[:2]]
    return [part for part in (first, others) if part]


def run(tests: list[str], copy: Path, layer: str, limit: float):
    """Run tests; return which one failed, "" if none did, and the CPU seconds."""
    chosen = copy / "chosen.json"
    chosen.write_text(json.dumps(tests))
    files = list(dict.fromkeys(test.partition("::")[0] for test in tests))

    def limited():
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit) + 5))

    output = copy / "output.txt"
    with output.open("w") as file:
        process = subprocess.Popen(
            [
                *PYTEST,
                *LAYERS[layer],
                "-x",
                "--tb=no",
                "-p",
                "no:cacheprovider",
                *files,
            ],
            cwd=copy,
            env=environment(copy, **{CHOSEN: str(chosen)}),
            stdout=file,
            stderr=subprocess.STDOUT,
            preexec_fn=limited,
            start_new_session=True,
        )
        # One that waits for ever uses no CPU.
        deadline = time.monotonic() + 20 * limit
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            if time.monotonic() > deadline:
                process.kill()
            time.sleep(0.05)
    _, status, usage = ended
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = usage.ru_utime + usage.ru_stime
    if process.returncode in (0, NO_TESTS):
        return "", seconds
    if process.returncode == WRONG_USAGE:
        raise RuntimeError(output.read_text())
    if process.returncode < 0:
        return f"signal {-process.returncode}, after {seconds:.0f} s", seconds
    failed = [
        line.partition(" - ")[0]
        for line in output.read_text().splitlines()
        if line.startswith(("FAILED ", "ERROR "))
    ]
    return (failed or [f"exit code {process.returncode}"])[0], seconds


def main(argv: list[str] | None = None) -> None:
    """Print the verdicts, the survivors last."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.mutation", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--places", type=int, default=200, help="how many changes")
    parser.add_argument("--seed", type=int, default=0, help="of the random places")
    parser.add_argument("--layer", choices=LAYERS, default="quick")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument(
        "--cpu", type=float, default=120, help="most CPU seconds of tests for a change"
    )
    parser.add_argument("--map", type=Path, help="where the covered lines are recorded")
    options = parser.parse_args(argv)
    default = f"isa_nrsfm_mutation_{options.layer}_{digest()}.json"
    path = options.map or Path(tempfile.gettempdir(), default)
    coverage = recorded(path, options.layer, options.jobs)
    chosen = places(options.places, options.seed)
    counts: dict[str, list] = {"killed": [], "survived": [], "not covered": []}
    with tempfile.TemporaryDirectory() as folder:
        copies: SimpleQueue = SimpleQueue()
        for i in range(options.jobs):
            copies.put(copy_of_checkout(Path(folder, str(i))))

        def verdict(number, mutant):
            copy = copies.get()
            try:
                args = (coverage, options.layer, options.cpu, number)
                return mutant, judge(mutant, copy, *args)
            finally:
                copies.put(copy)

        with ThreadPoolExecutor(options.jobs) as pool:
            futures = [pool.submit(verdict, *each) for each in enumerate(chosen)]
            for future in as_completed(futures):
                mutant, found = future.result()
                counts[found.status].append((mutant, found))
                print(line_of(mutant, found), flush=True)
    seconds = sum(v.seconds for each in counts.values() for _, v in each)
    print(f"\n{len(counts['killed'])} of {len(chosen)} killed, CPU {seconds:.0f} s")
    for status in ("not covered", "survived"):
        print(f"\n{len(counts[status])} {status}")
        for mutant, found in sorted(counts[status]):
            print(line_of(mutant, found))


def line_of(mutant: Mutant, verdict: Verdict) -> str:
    """Return a line that says what was changed and what became of it."""
    place = f"{mutant.file}:{mutant.line}"
    tests = f"{verdict.n_tests} of {verdict.n_covering} tests"
    end = f"{verdict.by or tests}, {verdict.seconds:.0f} s"
    return f"{verdict.status}: {place}: {mutant.before} -> {mutant.after} ({end})"


if __name__ == "__main__":
    main()
