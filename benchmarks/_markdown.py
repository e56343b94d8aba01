"""Tables of records in markdown."""

import numpy as np

# Numbers below this, of errors that would be 1 or 100 without a method, are shown as 0.
ROUNDING = 1e-12


def table(headings, rows):
    """
    Return a markdown table.

    Parameters
    ----------
    headings : list of str
        One a column.
    rows : list of list of str
        Cells; the first of each row is its name.

    Returns
    -------
    str
        The table, columns other than the first to the right.
    """
    rule = ["---", *("--:" for _ in headings[1:])]
    lines = ["| " + " | ".join(cells) + " |" for cells in (headings, rule, *rows)]
    return "\n".join(lines) + "\n"


def number(value, digits=3):
    """Return a number with some significant digits, without an exponent if it can."""
    if value is None:
        return ""
    if abs(value) < ROUNDING:
        return "0"
    if not 1e-5 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = max(digits - 1 - int(np.floor(np.log10(abs(value)))), 0)
    return f"{value:.{decimals}f}"


def spread(values, digits=3):
    """Return the median of some numbers, and their range where they differ."""
    if not values:
        return ""
    least, median, most = (
        number(v, digits) for v in np.percentile(values, (0, 50, 100))
    )
    return median if least == most else f"{median} ({least} to {most})"


def failure(records):
    """Return in a word why none of some records has a result."""
    if any(record.status == "over time" for record in records):
        return next(r.message for r in records if r.status == "over time")
    return "error" if records else ""


def cell(records, measure, digits=3):
    """
    Return the entry of a table for the records of one method and set.

    Parameters
    ----------
    records : list of Record
        One a seed.
    measure : callable
        Returns a number of a record, or None.
    digits : int, default=3
        Significant digits.

    Returns
    -------
    str
        Median and range, "over 600 s", or "error".
    """
    values = found(records, measure)
    if values:
        n_failed = sum(record.status != "ok" for record in records)
        return spread(values, digits) + (f", {n_failed} failed" if n_failed else "")
    return "" if any(record.status == "ok" for record in records) else failure(records)


def found(records, measure):
    """Return what records that succeeded have of a measure."""
    values = [measure(record) for record in records if record.status == "ok"]
    return [value for value in values if value is not None]


def value(name):
    """Return a function from a record to one of its values, None where it has none."""
    return lambda record: record.values.get(name)


def select(records, **keys):
    """Return the records with given attributes or parameters."""
    return [
        record
        for record in records
        if all(
            getattr(record, key, None) == wanted
            if key in record._fields
            else record.parameters.get(key) == wanted
            for key, wanted in keys.items()
        )
    ]


def grid(records, row_titles, column_titles, measure, *, corner="", digits=3):
    """
    Return a table with a row a method and a column a set.

    Parameters
    ----------
    records : list of Record
        Of a section.
    row_titles, column_titles : dict of str
        Titles of methods and of sets, in the order in which they are shown. Those
        without a record are left out.
    measure : callable
        Returns a number of a record, or None.
    corner : str, default=""
        Heading of the first column.
    digits : int, default=3
        Significant digits.

    Returns
    -------
    str
        The table.
    """
    rows = {name for name in row_titles if select(records, method=name)}
    columns = [name for name in column_titles if select(records, set=name)]
    return table(
        [corner, *(column_titles[name] for name in columns)],
        [
            [
                row_titles[name],
                *(
                    cell(select(records, method=name, set=column), measure, digits)
                    for column in columns
                ),
            ]
            for name in row_titles
            if name in rows
        ],
    )


def remarks(records, titles):
    """Return the errors of records as a list, each with its method and set."""
    lines = []
    for record in records:
        if record.status == "error":
            where = f"{titles.get(record.method, record.method)}, {record.set}"
            lines.append(f"- {where}, seed {record.seed}: {record.message}")
    return "".join(f"{line}\n" for line in dict.fromkeys(lines))


def footnote(results, records):
    """Return in what environments records were measured."""
    dates = {}
    for key in dict.fromkeys(record.environment for record in records):
        facts = results.environments[key]
        listed = ", ".join(f"{name} {facts[name]}" for name in facts)
        dates.setdefault(listed, []).append(key.partition("T")[0])
    return "\n".join(
        f"Measured {', '.join(dict.fromkeys(days))}: {listed}.\n"
        for listed, days in dates.items()
    )
