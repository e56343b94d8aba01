"""Values in files of skops, read from an explicit list of kinds.

A file of skops is a zip archive: `schema.json` is a tree of nodes, each with a kind
(its loader) and the name of a type, and arrays are files in numpy's format. skops
writes them. They are read here, to plain values only, so that no type is looked up by
its name and no code of it runs, whatever stands in the file.
"""

import io
import json
import warnings
from typing import Any, NamedTuple
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.stored_arrays import array_in

#: Types of the numbers and texts of a model.
PLAIN_TYPES = (bool, int, float, str)
NUMPY_TYPES = (
    np.bool_,
    *(np.int8, np.int16, np.int32, np.int64),
    *(np.uint8, np.uint16, np.uint32, np.uint64),
    *(np.float16, np.float32, np.float64),
    np.str_,
)
_NUMPY_NAMES = {f"numpy.{kind.__name__}": kind for kind in NUMPY_TYPES}
_OWN = "isa_nrsfm."


class NamedValue(NamedTuple):
    """
    An object of which only the name of its class and what it held are read.

    Attributes
    ----------
    name : str
        Name of the class, without its module.
    content : dict or tuple
        What it held: attributes by name, or the fields of a named tuple.
    """

    name: str
    content: Any


def read_values(contents: bytes) -> Any:
    """
    Return what a file of skops holds, as plain values.

    Parameters
    ----------
    contents : bytes
        The file.

    Returns
    -------
    object
        None, bool, int, float, str, list, tuple, dict, numpy array (one of objects as a
        list), number of numpy, or `NamedValue` for objects of this package and for
        states of numpy's random numbers.

    Raises
    ------
    ValueError
        If the file is damaged, holds anything else, or unpacks to more than it is
        large.
    """
    # What damaged archives and arrays make of their readers is not documented.
    try:
        with warnings.catch_warnings(), ZipFile(io.BytesIO(contents)) as archive:
            warnings.simplefilter("error")
            file = _BoundedArchive(archive, len(contents))
            return _value(json.loads(file.read("schema.json")), file)
    except Exception as error:
        raise ValueError(str(error) or type(error).__name__) from error


class _BoundedArchive:
    """
    An archive of which no more is read than it has bytes.

    `save_model` writes archives that are not compressed. An array that a model has in
    two places is one file of the archive. It is read once, and is one array then, too.

    Parameters
    ----------
    archive : ZipFile
        The archive.
    n_bytes : int
        Its size.
    """

    def __init__(self, archive: ZipFile, n_bytes: int) -> None:
        self._archive, self._n_bytes, self._n_read = archive, n_bytes, 0
        self._arrays: dict[str, NDArray] = {}

    def read(self, name: str) -> bytes:
        """Return the content of a file of the archive, or raise."""
        found = self._archive.getinfo(name)
        self._n_read += found.file_size
        if self._n_read > self._n_bytes:
            raise ValueError(
                f"its contents need more than the {self._n_bytes} bytes that it has: "
                "model files are not compressed"
            )
        return self._archive.read(found)

    def array(self, name: str) -> NDArray:
        """Return the array in a file of the archive, or raise."""
        if name not in self._arrays:
            self._arrays[name] = array_in(self.read(name))
        return self._arrays[name]


def _value(node: Any, file: "_BoundedArchive") -> Any:
    """Return the value of a node."""
    kind, name = node["__loader__"], f"{node['__module__']}.{node['__class__']}"
    is_own = name.startswith(_OWN)
    if (kind, name) == ("JsonNode", "builtins.str"):
        return json.loads(node["content"])
    if kind == "NdArrayNode" and (name == "numpy.ndarray" or name in _NUMPY_NAMES):
        return _array(node, name, file)
    if (kind, name) == ("ListNode", "builtins.list"):
        return [_value(item, file) for item in node["content"]]
    if (kind, name) == ("DictNode", "builtins.dict"):
        return _dict(node, file)
    if (kind, name) == ("TupleNode", "builtins.tuple"):
        return tuple(_value(item, file) for item in node["content"])
    if kind == "TupleNode" and is_own:
        fields = tuple(_value(item, file) for item in node["content"])
        return NamedValue(node["__class__"], fields)
    if kind == "ObjectNode" and is_own:
        return NamedValue(node["__class__"], _value(node["content"], file))
    if (kind, name) == ("RandomStateNode", "numpy.random.mtrand.RandomState"):
        return NamedValue("RandomState", _value(node["content"], file))
    raise ValueError(f"it contains objects that are not part of a model: {name}")


def _dict(node: Any, file: "_BoundedArchive") -> dict[str, Any]:
    """Return the value of a node of a dict with keys that are text."""
    types = [
        f"{key['__module__']}.{key['__class__']}"
        for key in node["key_types"]["content"]
    ]
    if types != ["builtins.str"] * len(node["content"]):
        raise ValueError("it contains a dict with keys that are not text")
    return {key: _value(item, file) for key, item in node["content"].items()}


def _array(node: Any, name: str, file: "_BoundedArchive") -> Any:
    """Return the value of a node of an array or of a number of numpy."""
    if name == "numpy.ndarray" and node["type"] == "json":
        items = [_value(item, file) for item in node["content"]]
        if _value(node["shape"], file) != (len(items),):
            raise ValueError("it contains an array of objects with several axes")
        return items
    array = file.array(node["file"])
    if name == "numpy.ndarray":
        return array
    number: Any = array[()]
    if type(number) is not _NUMPY_NAMES[name]:
        raise ValueError(f"{node['file']} should be of type {name}; got {array.dtype}")
    return number
