"""A plugin of pytest: CPU seconds of tests that pass, and tests that were chosen.

Files are named by environment variables, as workers of pytest-xdist have them, too.
"""

import json
import os
from pathlib import Path

import pytest

SECONDS = "MUTATION_SECONDS"  # a folder
CHOSEN = "MUTATION_CHOSEN"  # a file with a list of tests


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Add a line with the seconds of a test that passes to the file of this process."""
    before, failed = os.times(), item.session.testsfailed
    result = yield
    if SECONDS in os.environ and item.session.testsfailed == failed:
        after = os.times()
        seconds = sum(after[:4]) - sum(before[:4])
        path = Path(os.environ[SECONDS], f"{os.getpid()}.jsonl")
        with path.open("a") as file:
            file.write(json.dumps([item.nodeid, seconds]) + "\n")
    return result


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Leave the chosen tests, in their order."""
    if CHOSEN in os.environ:
        chosen = json.loads(Path(os.environ[CHOSEN]).read_text())
        place = {name: i for i, name in enumerate(chosen)}
        left_out = [item for item in items if item.nodeid not in place]
        config.hook.pytest_deselected(items=left_out)
        items[:] = sorted(
            (item for item in items if item.nodeid in place),
            key=lambda item: place[item.nodeid],
        )
