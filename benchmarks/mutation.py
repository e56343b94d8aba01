"""
Break the core in random places with mutmut, and let the quick tests notice it.

    python -m benchmarks.mutation --places 200 --seed 0 --jobs 2

``[tool.mutmut]`` in pyproject.toml says what is broken, and which tests run. The first
call writes all broken functions, and which tests run them, to the folder ``mutants``:
this takes two runs of the quick tests in one process and some minutes. Later calls
repeat what belongs to changed files. ``mutmut show NAME`` prints a change. Not every
change that survives is one that tests must notice: it may change nothing, or only the
number of steps.
"""

import argparse
import json
import random
import subprocess
import sys
from pathlib import Path


def main():
    """Draw broken places, and let mutmut print which of them survive."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.mutation", description=__doc__.strip().split("\n")[0]
    )
    parser.add_argument("--places", type=int, default=200, help="how many changes")
    parser.add_argument("--seed", type=int, default=0, help="of the random places")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    options = parser.parse_args()
    run = [sys.executable, "-m", "mutmut", "run", "--max-children", str(options.jobs)]
    # Write all changes, and try none: mutmut says that none has this name.
    subprocess.run([*run, "none"], stderr=subprocess.DEVNULL)
    names = [
        name
        for path in Path("mutants").rglob("*.meta")
        for name in json.loads(path.read_text(encoding="utf-8"))["exit_code_by_key"]
    ]
    chosen = random.Random(options.seed).sample(sorted(names), options.places)
    sys.exit(subprocess.run([*run, *chosen]).returncode)


if __name__ == "__main__":
    main()
