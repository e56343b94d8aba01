"""Damage to small valid files: to bytes, to lines and cells, and to what formats hold.

Every function takes a generator of random numbers, so that a damage can be made again.
"""

import io
import json
import zipfile
from decimal import Decimal

import numpy as np

# What may stand in the place of a number of a text.
WORDS = (
    *("", " ", "nan", "inf", "-inf", "-1", "0", "1.5", "1e308", "1e400", "1e-320"),
    *("99999999999999999999999", "1_0", "0x10", "1;5", "=1+1", "text", "é", "\x00"),
    *("None", "TRUE", '"', "'", "1e5e5", "２", "-nan(ind)", "#", "{", "}", "a b"),
)
# What may stand in the place of a value of a tree.
VALUES = (
    *(None, True, 0, -1, 1.5, 2**31, 2**63, 10**400, 1e308, np.nan, np.inf),
    *("", "text", "é\x00\n", [], {}, [[]], [None], ["x"], {"x": 1}),
)
ENCODINGS = ("utf-8-sig", "utf-16", "utf-16-be", "utf-32", "latin-1", "cp1252")
# The most places of a chunk that is left out, repeated or put elsewhere.
LONGEST_CHUNK = 40


def pick(rng, choices):
    """Return one of several things."""
    return choices[int(rng.integers(len(choices)))]


def damaged_bytes(content, rng):
    """Return bytes of which some are changed, lost, repeated or put elsewhere."""
    if len(content) == 0:
        return b"\x00"
    data = bytearray(content)
    start = int(rng.integers(len(data)))
    stop = start + int(rng.integers(1, LONGEST_CHUNK))
    match int(rng.integers(9)):
        case 0:  # bits
            for place in rng.integers(len(data), size=rng.integers(1, 4)):
                data[place] ^= 1 << int(rng.integers(8))
        case 1:  # bytes that many formats give a meaning
            for place in rng.integers(len(data), size=rng.integers(1, 4)):
                data[place] = pick(rng, b',"\n\r\t{}[]:-e. x\x00\xff\x80\x7f')
        case 2:
            del data[start:]
        case 3:
            del data[start:stop]
        case 4:
            data[start:start] = data[start:stop]
        case 5:
            data[start:start] = rng.bytes(stop - start)
        case 6:
            data[start:stop] = bytes(len(data[start:stop]))
        case 7:
            other = int(rng.integers(len(data)))
            chunk = data[start:stop]
            del data[start:stop]
            data[other:other] = chunk
        case 8:  # a length or a number of rows that is far too large
            data[start : start + 4] = b"\xff\xff\xff\x7f"[: len(data) - start]
    return bytes(data)


def damaged_text(text, rng, separator=","):
    """Return the bytes of a text of which lines, cells or the encoding are damaged."""
    lines = text.splitlines()
    here, there = (int(i) for i in rng.integers(len(lines), size=2))
    ending, encoding = "\n", "utf-8"
    match int(rng.integers(10)):
        case 0:
            del lines[here]
        case 1:
            lines.insert(there, lines[here])
        case 2:
            lines.insert(
                here, pick(rng, ("", " ", separator, "text", "\x00", "{", '"'))
            )
        case 3:
            lines[here], lines[there] = lines[there], lines[here]
        case 4:
            ending = pick(rng, ("\r\n", "\r", "\n\n", "\x0b", "\x00\n"))
        case 5:
            encoding = pick(rng, ENCODINGS)
        case 6:
            lines = lines[: here + 1]
            lines[-1] = lines[-1][: int(rng.integers(len(lines[-1]) + 1))]
        case _:
            lines[here] = _damaged_cells(lines[here], rng, separator)
    whole = ending.join(lines) + ending
    return whole.encode(encoding, errors="replace")


def _damaged_cells(line, rng, separator):
    """Return a line of which a cell is lost, repeated, exchanged or another one."""
    cells = line.split(separator)
    here, there = (int(i) for i in rng.integers(len(cells), size=2))
    match int(rng.integers(5)):
        case 0:
            del cells[here]
        case 1:
            cells.insert(there, cells[here])
        case 2:
            cells[here], cells[there] = cells[there], cells[here]
        case _:
            cells[here] = pick(rng, WORDS)
    return separator.join(cells)


def damaged_tree(tree, rng):
    """Return a copy of what json holds, of which one part is another or missing."""
    tree = json.loads(json.dumps(tree))
    places = _places(tree)
    if not places:
        return pick(rng, VALUES)
    parent, key = pick(rng, places)
    match int(rng.integers(8)):
        case 0:
            del parent[key]
        case 1:
            other, name = pick(rng, places)
            parent[key] = json.loads(json.dumps(other[name]))
        case 2 if isinstance(parent, list):
            parent.insert(key, json.loads(json.dumps(parent[key])))
        case 2:
            parent[pick(rng, WORDS)] = parent.pop(key)
        case 3 if isinstance(parent[key], str):
            parent[key] += pick(rng, ("x", " ", ".", "/..", "\x00"))
        case 4 if rng.integers(10) == 0:
            for _ in range(int(rng.integers(10, 5000))):
                parent[key] = [parent[key]]
        case _:
            parent[key] = pick(rng, VALUES)
    return tree


def _places(tree):
    """Return the places of a tree: lists or objects, with an index or a key."""
    inner = tree.items() if isinstance(tree, dict) else ()
    inner = enumerate(tree) if isinstance(tree, list) else inner
    return [place for key, value in inner for place in [(tree, key), *_places(value)]]


def as_json(tree):
    """Return json, which may be nested too deep for Python's writer."""
    try:
        return json.dumps(tree).encode()
    except RecursionError:
        return b"[" * 100_000 + b"]" * 100_000


def damaged_array(array, rng):
    """Return an array of another type, shape or content."""
    array = np.asarray(array)
    kinds = "? i1 u8 f2 f4 >f8 g c16 U3 S2 M8[s]".split()
    shapes = ((), (0,), (1,), (0, 3), (3, 0), (2, 2, 2))
    changes = [
        lambda: array[..., None],
        lambda: array[None],
        lambda: array.T.copy(),
        lambda: array[: len(array) // 2] if array.ndim else array[None],
        lambda: array.ravel()[: int(rng.integers(2)) * array.size],
        lambda: np.array([None, "x", 1.0], dtype=object),
        lambda: np.zeros(2, dtype=[("a", "f8"), ("b", "U2")]),
        lambda: np.zeros(pick(rng, shapes)),
        lambda: np.full(array.shape, pick(rng, (2**62, -(2**63), -1, 0))),
    ]
    if array.dtype.kind in "fiub":
        changes += 2 * [lambda: array.astype(pick(rng, kinds))]
    if array.dtype.kind == "f" and array.size:
        changes += 4 * [lambda: _with_value(array.copy(), rng)]
    with np.errstate(all="ignore"):
        return pick(rng, changes)()


def _with_value(array, rng):
    """Set one number of an array, or all, to an unusual one."""
    where = ... if rng.integers(4) == 0 else int(rng.integers(array.size))
    array.flat[where] = pick(
        rng, (np.nan, np.inf, -np.inf, 1e308, 1e160, 0.0, -1.0, 5e-324)
    )
    return array


def as_npy(array):
    """Return the bytes of an array in numpy's format, pickled where it has to be."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def damaged_npy(content, rng):
    """Return the bytes of an array of which the header, or the array, is another."""
    if rng.integers(3) == 0:
        header_end = content.index(b"\n")
        header = damaged_text(content[10:header_end].decode("latin-1"), rng, " ")
        return content[:10] + header + content[header_end + 1 :]
    return as_npy(damaged_array(np.load(io.BytesIO(content)), rng))


def damaged_archive(content, rng):
    """Return a zip archive of arrays of which one is damaged, lost or another."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    name, other = pick(rng, [*files]), pick(rng, [*files])
    compression = zipfile.ZIP_STORED
    match int(rng.integers(9)):
        case 0:
            del files[name]
        case 1:
            files[name] = files[other]
        case 2:
            files[name] = damaged_bytes(files[name], rng)
        case 3:  # a small file that unpacks to much
            compression = zipfile.ZIP_DEFLATED
            files[name] = as_npy(np.zeros(2**21))
        case 4:  # an array that claims to be very large
            whole = as_npy(np.zeros(0))
            files[name] = whole.replace(b"(0,), }" + b" " * 10, b"(10000000000,), }")
        case 5:
            files[pick(rng, ("x", "../x", "/x", "x/"))] = b"text"
        case _:
            files[name] = damaged_npy(files[name], rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for file, data in files.items():
            archive.writestr(file, data)
    return buffer.getvalue()


def damage_hdf5(path, rng):
    """Change an HDF5 file: a dataset, a group or an attribute is lost or another."""
    import h5py

    empty = h5py.Empty("f8")
    plain = [v for v in VALUES if isinstance(v, int | float | str | bool)]
    plain = [v for v in plain if v not in (10**400, "é\x00\n")]
    with h5py.File(path, "r+") as file:
        names = []
        file.visit(names.append)
        names = [name for name in names if "/_i_" not in name]  # indices of PyTables
        holder = pick(rng, [file, *(file[name] for name in names)])
        # Names in capitals are those of PyTables, of which there are many.
        known = [name for name in holder.attrs if not name.isupper()]
        if known and rng.integers(2):
            name = pick(rng, known)
            if rng.integers(5) == 0:
                del holder.attrs[name]
            else:
                others = [empty, np.full((2, 2), -1.0), np.bytes_(b"x"), *plain]
                holder.attrs[name] = pick(rng, others)
            return
        name, other = pick(rng, names), pick(rng, names)
        old = file[name][()] if isinstance(file[name], h5py.Dataset) else None
        attributes = dict(file[name].attrs)
        del file[name]
        match int(rng.integers(8)):
            case 0:
                return
            case 1:
                file.create_group(name)
            case 2:
                file[name] = h5py.SoftLink(pick(rng, ("/nowhere", f"/{name}", "/")))
                return
            case 3 if other in file:
                file[name] = file[other]
            case 4:  # a dataset that claims to be very large, and has no data
                file.create_dataset(name, shape=(2**40,), dtype="f8", chunks=True)
            case 5 | 6 if isinstance(old, np.ndarray) and old.dtype.names is None:
                new = damaged_array(old, rng)
                file[name] = new if new.dtype.kind in "fiucb" else [b"text"] * 3
            case 5 | 6 if isinstance(old, np.ndarray) and old.size:
                file[name] = old[: int(rng.integers(len(old)))]
            case _:
                others = (empty, 1.0, 3, "text", b"bytes", [], ["a", "b"], [[1, 2]])
                file[name] = pick(rng, others)
        for key, value in attributes.items():
            file[name].attrs[key] = value


def damaged_parquet(content, rng):
    """Return a parquet file of which a column, or its metadata, is another."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(content))
    place, n = int(rng.integers(table.num_columns)), table.num_rows
    columns = (
        *([None] * n, ["1.5"] * n, [True] * n, [b"x"] * n, [[1.0]] * n),
        *([{"a": 1}] * n, [2**62] * n, [np.inf] * n, [1e308] * n, [np.nan] * n),
        *([Decimal("1.5")] * n, np.full(n, 1.5, np.float16)),
        np.arange(n).astype("M8[s]"),
    )
    said = dict(table.schema.metadata or {b"pandas": b"{}"})
    match int(rng.integers(8)):
        case 0:
            table = table.remove_column(place)
        case 1:
            table = table.append_column(table.column_names[place], table.column(place))
        case 2:
            table = table.slice(0, int(rng.integers(n)))
        case 3:
            table = table.select([])
        case 4:
            key = pick(rng, [*said])
            table = table.replace_schema_metadata(
                {**said, key: damaged_bytes(said[key], rng)}
            )
        case _:
            changed = pa.array(pick(rng, columns))
            table = table.set_column(place, table.column_names[place], changed)
            table = table.replace_schema_metadata(said)
    buffer = io.BytesIO()
    pq.write_table(table, buffer, row_group_size=pick(rng, (1, 1000)))
    return buffer.getvalue()
