"""A reader of GLB files that shares nothing with the writer: it follows the glTF 2.0 specification."""

import json
import struct

import numpy as np

_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_glb(path):
    """Return the JSON and the attributes of the only primitive by name."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    content = json.loads(data[20 : 20 + size])
    body_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and body_size % 4 == 0 and 28 + size + body_size == len(data)
    body = data[28 + size :]
    assert content["buffers"] == [{"byteLength": len(body)}]
    (mesh,) = content["meshes"]
    (primitive,) = mesh["primitives"]
    assert primitive["mode"] == 0
    attributes = {}
    for name, index in primitive["attributes"].items():
        accessor = content["accessors"][index]
        view = content["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(_DTYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        assert view["byteOffset"] % 4 == 0 and (dtype.itemsize * width) % 4 == 0
        assert accessor["count"] * width * dtype.itemsize == view["byteLength"]
        values = np.frombuffer(body, dtype, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        if accessor.get("normalized"):
            values = values / np.iinfo(dtype).max
        attributes[name] = values
    return content, attributes
