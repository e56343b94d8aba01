"""The run of the command fit that the files of a folder belong to.

The report has the SHA-256 digests of the model and the other files of its run.
"""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from isa_nrsfm._compat.caller import warn_caller

REPORT = "report.json"
DIGESTS = "sha256"


def digests_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the digests of those of the files that are in a folder."""
    found = {}
    for name in names:
        if (folder / name).is_file():
            with (folder / name).open("rb") as file:
                found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def files_of_report(folder: Path) -> set[str]:
    """Return the names of the files that the report in a folder lists."""
    return set(_entry(folder, "files"))


def is_of_run(folder: Path, report: dict[str, Any]) -> bool:
    """Return whether the files in a folder are those that a report has digests of."""
    return digests_of(folder, report[DIGESTS]) == report[DIGESTS]


def warn_of_mixed_runs(model: str) -> None:
    """Warn if files beside a model are not of the run that the report is of."""
    folder, name = Path(model).parent, Path(model).name
    recorded = _entry(folder, DIGESTS)
    # A report that does not know the model is of something else.
    if name not in recorded:
        return
    beside = digests_of(folder, (name for name in recorded if Path(name).name == name))
    differing = [name for name in beside if beside[name] != recorded[name]]
    if differing:
        warn_caller(
            f"{folder / REPORT} is of another run than {', '.join(differing)} beside "
            "it, or these were changed since"
        )


def _entry(folder: Path, name: str) -> dict[str, Any]:
    """Return an entry of the report in a folder, without one an empty dict."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
        return dict(report[name])
    except (OSError, ValueError, TypeError, KeyError):
        return {}
