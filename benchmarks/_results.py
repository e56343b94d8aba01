"""Records of runs in a json file, and tables of them in markdown."""

import json
import os
import platform
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import scipy
import sklearn

import isa_nrsfm

# Numbers below this, of errors that would be 1 or 100 without a method, are shown as 0.
ROUNDING = 1e-12


def read(path):
    """Return the environments by key and the records of a file that need not exist."""
    if not Path(path).is_file():
        return {"environments": {}, "records": []}
    return json.loads(Path(path).read_text(encoding="utf-8"))


def write(path, stored):
    """Write environments and records, without environments that have no record."""
    used = {record["environment"] for record in stored["records"]}
    kept = {key: facts for key, facts in stored["environments"].items() if key in used}
    text = json.dumps(stored | {"environments": kept}, indent=1, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".tmp")
    unfinished.write_text(text + "\n", encoding="utf-8")
    os.replace(unfinished, path)


def environment(**settings):
    """Return the key of the present environment, and what it is."""
    key = datetime.now().astimezone().isoformat(timespec="seconds")
    return key, {
        "isa_nrsfm": isa_nrsfm.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "scikit-learn": sklearn.__version__,
        "system": f"{platform.system()} {platform.machine()}",
        "cpus": os.cpu_count(),
        **settings,
    }


def section_of(stored, section):
    """Return the records of a section: a column a parameter and a value.

    The inverse SNR is in percent.
    """
    records = [r for r in stored["records"] if r["section"] == section]
    flat = [record | record["parameters"] | record["values"] for record in records]
    table = pd.DataFrame(flat)
    if "inverse_snr" in table:
        table["inverse_snr"] *= 100
    return table


def select(records, **columns):
    """Return the records with given values in columns; all, if it is None."""
    for name, wanted in columns.items():
        records = records[records[name] == wanted]
    return records


def found(records, measure):
    """Return what records that succeeded have of a measure, as an array."""
    if measure not in records:
        return np.array([])
    values = records.loc[records["status"] == "ok", measure]
    return values.dropna().to_numpy(dtype=float)


def table(headings, rows):
    """Return a markdown table of texts, columns other than the first to the right."""
    rule = ["---", *("--:" for _ in headings[1:])]
    lines = ["| " + " | ".join(cells) + " |" for cells in (headings, rule, *rows)]
    return "\n".join(lines) + "\n"


def number(value, digits=3):
    """Return a number with some significant digits, without an exponent if it can."""
    if abs(value) < ROUNDING:
        return "0"
    if not 1e-5 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = max(digits - 1 - int(np.floor(np.log10(abs(value)))), 0)
    return f"{value:.{decimals}f}"


def cell(records, measure, digits=3):
    """Return median and range of a measure, "over 600 s", "error", or nothing."""
    values, failed = found(records, measure), records[records["status"] != "ok"]
    if len(values):
        least, median, most = (
            number(v, digits) for v in np.percentile(values, (0, 50, 100))
        )
        text = median if least == most else f"{median} ({least} to {most})"
        return text + (f", {len(failed)} failed" if len(failed) else "")
    if len(failed) < len(records) or failed.empty:
        return ""
    late = failed.loc[failed["status"] == "over time", "message"]
    return late.iloc[0] if len(late) else "error"


def grid(
    records,
    titles,
    headings,
    measure,
    *,
    row="method",
    column="set",
    corner="method",
    digits=3,
):
    """
    Return a table with a row a method and a column a set, or of other columns.

    Parameters
    ----------
    records : DataFrame
        Of a section.
    titles, headings : dict of str
        Titles of the values of `row` and `column`, in order. Those without a record
        are left out.
    measure : str
        A column.
    row, column : str
        Columns.
    corner : str, default="method"
        Heading of the first column.
    digits : int, default=3
        Significant digits.

    Returns
    -------
    str
        The table, empty without records.
    """
    if records.empty:
        return ""
    cells = {
        key: cell(group, measure, digits)
        for key, group in records.groupby([row, column])
    }
    columns = [name for name in headings if (records[column] == name).any()]
    rows = [
        [title, *(cells.get((name, other), "") for other in columns)]
        for name, title in titles.items()
        if (records[row] == name).any()
    ]
    return table([corner, *(headings[name] for name in columns)], rows)


def remarks(records, titles):
    """Return the errors of records as a list, each with its method and set."""
    lines = [
        f"- {titles.get(r.method, r.method)}, {r.set}, seed {r.seed}: {r.message}\n"
        for r in records[records["status"] == "error"].itertuples()
    ]
    return "".join(dict.fromkeys(lines))


def footnote(environments, records):
    """Return in what environments records were measured."""
    days = {}
    for key in records["environment"].unique():
        facts = ", ".join(f"{name} {fact}" for name, fact in environments[key].items())
        days.setdefault(facts, []).append(key.partition("T")[0])
    return "\n".join(
        f"Measured {', '.join(dict.fromkeys(dates))}: {facts}.\n"
        for facts, dates in days.items()
    )
