"""Damage to small valid files: to bytes, to lines and cells, and to what formats hold.

Every function takes a generator of random numbers, so that a damage can be made again.
"""

import io
import json

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
# What may stand in the place of a number of an array.
NUMBERS = (np.nan, np.inf, -np.inf, 1e308, 1e160, 0.0, -1.0, 5e-324)
ENCODINGS = ("utf-8-sig", "utf-16", "utf-16-be", "utf-32", "latin-1", "cp1252")
TOO_DEEP = 5000


def pick(rng, choices):
    """Return one of several things."""
    return choices[int(rng.integers(len(choices)))]


def damaged_items(items, rng, other):
    """Return a list of which an item is lost, repeated, exchanged or another one."""
    here, there = (int(i) for i in rng.integers(len(items), size=2))
    lost = [*items[:here], *items[here + 1 :]]
    repeated = [*items[:there], items[here], *items[there:]]
    exchanged = [*items]
    exchanged[here], exchanged[there] = items[there], items[here]
    kind = int(rng.integers(5))
    if kind < 3:
        return (lost, repeated, exchanged)[kind]
    return [*items[:here], other(items[here]), *items[here + 1 :]]


def damaged_bytes(content, rng):
    """Return bytes of which some are changed, lost or repeated."""
    start = int(rng.integers(len(content)))
    stop = start + int(rng.integers(1, 40))
    rest = content[start:]
    changes = [
        lambda: bytes([rest[0] ^ (1 << int(rng.integers(8)))]) + rest[1:],
        # A byte that many formats give a meaning
        lambda: bytes([pick(rng, b',"\n\r\t{}[]:-e. x\x00\xff\x80\x7f')]) + rest[1:],
        lambda: b"",
        lambda: content[stop:],
        lambda: content[start:stop] + rest,
        # A length or a number of rows that is far too large
        lambda: b"\xff\xff\xff\x7f"[: len(rest)] + rest[4:],
    ]
    return content[:start] + pick(rng, changes)()


def damaged_text(text, rng, separator=","):
    """Return the bytes of a text of which lines, cells or the encoding are damaged."""
    lines, ending, encoding = text.splitlines(), "\n", "utf-8"
    match int(rng.integers(8)):
        case 0 | 1:
            inserted = pick(rng, ("", " ", separator, "text", "\x00", "{", '"'))
            lines = damaged_items(lines, rng, lambda _: inserted)
        case 2:
            ending = pick(rng, ("\r\n", "\r", "\n\n", "\x0b", "\x00\n"))
        case 3:
            encoding = pick(rng, ENCODINGS)
        case _:
            here = int(rng.integers(len(lines)))
            cells = lines[here].split(separator)
            cells = damaged_items(cells, rng, lambda _: pick(rng, WORDS))
            lines[here] = separator.join(cells)
    whole = ending.join(lines) + ending
    return whole.encode(encoding, errors="replace")


def damaged_tree(tree, rng):
    """Return a copy of what json holds, of which one part is another or missing."""
    tree = json.loads(json.dumps(tree))
    places = _places(tree)
    if not places:
        return pick(rng, VALUES)
    parent, key = pick(rng, places)
    match int(rng.integers(6)):
        case 0:
            del parent[key]
        case 1:
            other, name = pick(rng, places)
            parent[key] = json.loads(json.dumps(other[name]))
        case 2 if isinstance(parent, dict):
            parent[pick(rng, WORDS)] = parent.pop(key)
        case 3 if isinstance(parent[key], str):
            parent[key] += pick(rng, ("x", " ", ".", "/..", "\x00"))
        case 4 if rng.integers(10) == 0:
            for _ in range(TOO_DEEP):
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

    def with_value():
        changed = array.copy()
        where = ... if rng.integers(4) == 0 else int(rng.integers(array.size))
        changed.flat[where] = pick(rng, NUMBERS)
        return changed

    changes = [
        lambda: array[..., None],
        lambda: array[None],
        lambda: array.T.copy(),
        lambda: array.ravel()[: array.size // 2],
        lambda: np.array([None, "x", 1.0], dtype=object),
        lambda: np.zeros(2, dtype=[("a", "f8"), ("b", "U2")]),
        lambda: np.zeros(pick(rng, shapes)),
        lambda: np.full(array.shape, pick(rng, (2**62, -(2**63), -1, 0))),
    ]
    if array.dtype.kind in "fiub":
        changes += 2 * [lambda: array.astype(pick(rng, kinds))]
    if array.dtype.kind == "f" and array.size:
        changes += 4 * [with_value]
    with np.errstate(all="ignore"):
        return pick(rng, changes)()


def damaged_npy(content, rng):
    """Return the bytes of an array that is another."""
    buffer = io.BytesIO()
    array = damaged_array(np.load(io.BytesIO(content)), rng)
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def damaged_archive(content, rng):
    """Return an archive of arrays of which one is damaged, lost or another."""
    arrays = dict(np.load(io.BytesIO(content)))
    name, other = pick(rng, [*arrays]), pick(rng, [*arrays])
    kind = int(rng.integers(6))
    if kind == 0:
        del arrays[name]
    elif kind == 2:
        arrays["x"] = np.zeros(3)
    else:
        arrays[name] = arrays[other] if kind == 1 else damaged_array(arrays[name], rng)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def damage_hdf5(path, rng):
    """Change an HDF5 file: a dataset, a group or an attribute is lost or another."""
    import h5py

    with h5py.File(path, "r+") as file:
        names = []
        file.visit(names.append)
        names = [name for name in names if "/_i_" not in name]  # indices of PyTables
        name, other = pick(rng, names), pick(rng, names)
        attributes = dict(file[name].attrs)
        others = [h5py.Empty("f8"), 1.0, 2**31, "text", b"x", [], ["a", "b"], [[1, 2]]]
        # Names in capitals are those of PyTables, of which there are many.
        known = [key for key in attributes if not key.isupper()]
        if known and rng.integers(2):
            file[name].attrs[pick(rng, known)] = pick(rng, others)
            return
        old = file[name][()] if isinstance(file[name], h5py.Dataset) else None
        if isinstance(old, np.ndarray) and old.dtype.names is None:
            new = damaged_array(old, rng)
            others += len(others) * [new if new.dtype.kind in "fiucb" else [b"text"]]
        del file[name]
        match int(rng.integers(8)):
            case 0:
                return
            case 1:
                file.create_group(name)
            case 2:  # a dataset that claims to be very large, and has no data
                file.create_dataset(name, shape=(2**40,), dtype="f8", chunks=True)
            case 3 if other in file:
                file[name] = file[other]
            case _:
                file[name] = pick(rng, others)
        file[name].attrs.update(attributes)
