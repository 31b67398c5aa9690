# SPDX-License-Identifier: Apache-2.0
"""Models of random Gaussians, and a reader of GLB files that follows the glTF 2.0 specification alone."""

import json
import struct

import numpy as np
import torch

from blitzgs.formats.gaussians import Gaussians


def some_gaussians(count, degree, seed=0, levels=False):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=3 * normal(count, 3),
        quats=normal(count, 4),
        scales=normal(count, 3) * 0.7 - 3,
        opacities=2 * normal(count),
        sh=0.2 * normal(count, (degree + 1) ** 2, 3),
        levels=torch.randint(0, 4, (count,), generator=generator).float() if levels else None,
    )


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
