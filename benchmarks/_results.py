"""Records of runs, and the json file that keeps them."""

import json
import os
import platform
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
import sklearn

import isa_nrsfm

FILE = "results.json"
DIGITS = 6  # that are kept of each number


class Record(NamedTuple):
    """
    A run, as it is stored.

    Attributes
    ----------
    section, set, method : str
        What was measured, on what, of what.
    seed : int
        Random seed.
    status : {"ok", "over time", "error"}
        What became of it.
    values : dict
        Figures by name, None where there is none.
    parameters : dict
        What else distinguishes it from other runs of the same section, set and method.
    seconds : float or None
        Of what was measured.
    memory : float or None
        Megabytes by which memory in use rose at most.
    message : str
        What went wrong.
    warnings : sequence of str
        What it warned of.
    environment : str
        Key of the environment in which it ran.
    """

    section: str
    set: str
    method: str
    seed: int
    status: str
    values: dict
    parameters: dict
    seconds: float | None = None
    memory: float | None = None
    message: str = ""
    warnings: tuple = ()
    environment: str = ""

    @property
    def group(self):
        """What is replaced as a whole when it is measured again."""
        return self.section, self.set, self.method


class Results:
    """
    All records of a file, in the order in which they were measured.

    Parameters
    ----------
    path : path-like
        The json file; it need not exist.
    """

    def __init__(self, path):
        self.path = Path(path)
        self.environments = {}
        self.records = []
        self._replaced = set()
        if self.path.is_file():
            stored = json.loads(self.path.read_text(encoding="utf-8"))
            self.environments = stored["environments"]
            self.records = [Record(**record) for record in stored["records"]]

    def begin(self, **settings):
        """Return the key of the present environment, with settings of the run."""
        key = datetime.now().astimezone().isoformat(timespec="seconds")
        self.environments[key] = environment() | settings
        return key

    def add(self, record):
        """Add a record; the first of a group replaces those of earlier calls."""
        if record.group not in self._replaced:
            self._replaced.add(record.group)
            self.records = [r for r in self.records if r.group != record.group]
        self.records.append(record._replace(values=rounded(record.values)))

    def of(self, section):
        """Return the records of a section."""
        return [record for record in self.records if record.section == section]

    def save(self):
        """Write the file, without environments of which no record is left."""
        used = {record.environment for record in self.records}
        kept = {key: self.environments[key] for key in self.environments if key in used}
        stored = {
            "environments": kept,
            "records": [record._asdict() for record in self.records],
        }
        self.path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = self.path.with_suffix(".tmp")
        text = json.dumps(stored, indent=1, ensure_ascii=False, allow_nan=False)
        unfinished.write_text(text + "\n", encoding="utf-8")
        os.replace(unfinished, self.path)


def environment():
    """Return versions and machine."""
    return {
        "isa_nrsfm": isa_nrsfm.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "scikit-learn": sklearn.__version__,
        "system": f"{platform.system()} {platform.machine()}",
        "cpus": os.cpu_count(),
    }


def rounded(value):
    """Return numbers with a few significant digits, None where not finite."""
    if isinstance(value, dict):
        return {str(key): rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [rounded(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    return value
