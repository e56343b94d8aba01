"""Readers of exported files: what is in them, by their specifications."""

import base64
import json
import re
import struct

import numpy as np

TYPES = {5126: "<f4", 5125: "<u4"}


class Read:
    """A .glb file, read as the specification has it."""

    def __init__(self, path):
        content = path.read_bytes()
        head = struct.unpack("<4sIII4s", content[:20])
        start = 20 + head[3]
        length, kind = struct.unpack("<I4s", content[start : start + 8])
        text, self.binary = content[20:start], content[start + 8 :]
        assert head == (b"glTF", 2, len(content), len(text), b"JSON")
        assert (length, kind) == (len(self.binary), b"BIN\0")
        assert len(text) % 4 == length % 4 == 0
        self.document = json.loads(text)
        assert self.document["buffers"] == [{"byteLength": length}]

    def array(self, number):
        accessor = self.document["accessors"][number]
        view = self.document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        start, end = view["byteOffset"], view["byteOffset"] + view["byteLength"]
        array = np.frombuffer(self.binary[start:end], TYPES[accessor["componentType"]])
        if accessor["type"] == "VEC3":
            array = array.reshape(-1, 3)
        assert len(array) == accessor["count"]
        for bound in {"min", "max"} & {*accessor}:
            expected = getattr(array, bound)(axis=0)
            np.testing.assert_array_equal(np.squeeze(accessor[bound]), expected)
        return array

    @property
    def mesh(self):
        return self.document["meshes"][0]

    def primitive(self, mode):
        (found,) = (p for p in self.mesh["primitives"] if p["mode"] == mode)
        return found


def content_of(path):
    """Return the data on a page."""
    text = path.read_text(encoding="utf-8")
    pattern = r'<script type="application/json" id="model">(.*?)</script>'
    return json.loads(re.search(pattern, text, re.DOTALL)[1])


def numbers(text, dtype="<f4"):
    """Return the numbers of a text on a page."""
    return np.frombuffer(base64.b64decode(text), dtype)
