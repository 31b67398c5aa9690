# SPDX-License-Identifier: Apache-2.0
"""The compiled readers of files (csrc/io), loaded when they are first needed.

They run without the GIL, if they take longer than it takes to get it back. Arrays that they return own the
memory that was filled; arguments are not copied if they have the wanted type.
"""

from __future__ import annotations

import ctypes
import json
import os
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs._built import LIBRARY_DIR

Array = npt.NDArray[Any]
Path = str | bytes


def _system_error(message: str) -> OSError:
    """Return the error that Python's own functions raise; the message is that of csrc/io/image_file.h."""
    number, _, path = message.partition(" ")
    return OSError(int(number), os.strerror(int(number)), path)


# In the order of blitzgs_io_type and blitzgs_io_status_code of csrc/io/io_api.cpp.
_TYPES = tuple(np.dtype(name) for name in ("u1", "u4", "i8", "u8", "f8"))
_ERRORS: tuple[Callable[[str], Exception] | None, ...] = (
    None, ValueError, ValueError, MemoryError, RuntimeError, _system_error,
)  # fmt: skip


class _Column(ctypes.Structure):
    _fields_ = [("data", ctypes.c_void_p), ("size", ctypes.c_size_t), ("type", ctypes.c_int32)]


@cache
def _library(kind: type[ctypes.CDLL]) -> ctypes.CDLL:
    """Load libblitzgs_io.so, whose functions keep the GIL if it is loaded as a `ctypes.PyDLL`.

    ImportError: it was not built, or cannot be loaded; says how to build it.
    """
    path = LIBRARY_DIR / "libblitzgs_io.so"
    try:
        library = kind(str(path))
    except OSError as error:
        raise ImportError(
            f"the readers of files are not built ({error}): run `pip install .`, or `make build` "
            "in a checkout"
        ) from error
    library.blitzgs_io_call.restype = ctypes.c_void_p
    library.blitzgs_io_call.argtypes = [ctypes.c_char_p, ctypes.POINTER(_Column), ctypes.c_size_t]
    library.blitzgs_io_columns.restype = ctypes.c_size_t
    library.blitzgs_io_columns.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.POINTER(_Column))]
    library.blitzgs_io_message.restype = ctypes.c_char_p
    for function in (library.blitzgs_io_message, library.blitzgs_io_status, library.blitzgs_io_free):
        function.argtypes = [ctypes.c_void_p]
    return library


class _Reply:
    """The memory of the results of a call, which lives as long as one of the arrays in it."""

    def __init__(self, handle: int, free: Callable[[int], None]) -> None:
        self._handle, self._free = handle, free

    def __del__(self) -> None:
        self._free(self._handle)


def _array_of(reply: _Reply, column: _Column) -> Array:
    dtype = _TYPES[column.type]
    if not column.size:
        return np.empty(0, dtype)
    memory: Any = (ctypes.c_byte * (column.size * dtype.itemsize)).from_address(column.data)
    memory.reply = reply  # whose memory it is
    return np.frombuffer(memory, dtype)


def _call(name: str, *arguments: Path | Array, keeps_gil: bool = False) -> list[Array]:
    """Call a function of csrc/io/io_api.cpp; arrays must be contiguous.

    `keeps_gil`: for microseconds of work. Whoever gets the GIL meanwhile may keep it for longer.
    """
    quick = _library(ctypes.PyDLL)
    library = quick if keeps_gil else _library(ctypes.CDLL)
    values = [os.fsencode(value) if isinstance(value, str) else value for value in arguments]
    columns = (_Column * len(values))()
    for column, value in zip(columns, values, strict=True):
        if isinstance(value, bytes):
            column.data, column.size = ctypes.cast(ctypes.c_char_p(value), ctypes.c_void_p).value, len(value)
        else:
            column.data, column.size = value.__array_interface__["data"][0], value.size
            column.type = _TYPES.index(value.dtype)
    handle = library.blitzgs_io_call(name.encode(), columns, len(columns))
    if not handle:
        raise MemoryError
    reply = _Reply(handle, library.blitzgs_io_free)
    if error := _ERRORS[quick.blitzgs_io_status(handle)]:
        raise error(os.fsdecode(quick.blitzgs_io_message(handle)))
    found = ctypes.POINTER(_Column)()
    count = quick.blitzgs_io_columns(handle, ctypes.byref(found))
    return [_array_of(reply, found[i]) for i in range(count)]


def _array(values: object, dtype: str) -> Array:
    return np.ascontiguousarray(values, np.dtype(dtype))


def _texts(characters: Array, ends: Array) -> list[str]:
    """Return texts; bytes that are not UTF-8 are decoded as by os.fsdecode."""
    data, begins = characters.tobytes(), [0, *ends.tolist()]
    return [os.fsdecode(data[begin:end]) for begin, end in zip(begins, begins[1:], strict=False)]


def camera_models() -> list[tuple[int, str, str]]:
    """Return the id, name and parameters (separated by commas) of every camera model of COLMAP."""
    ids, names, name_ends, params, param_ends = _call("camera_models")
    return list(zip(ids.tolist(), _texts(names, name_ends), _texts(params, param_ends), strict=True))


def read_cameras(path: Path) -> list[tuple[int, str, int, int, Array]]:
    """Read cameras.bin or .txt: the id, model, width, height and parameters (float64) of each."""
    ids, models, model_ends, widths, heights, params, ends = _call("read_cameras", path)
    each = np.split(params, ends[:-1].astype(np.int64)) if len(ids) else []
    names = _texts(models, model_ends)
    return list(zip(ids.tolist(), names, widths.tolist(), heights.tolist(), each, strict=True))


def read_images(path: Path, with_points2d: bool) -> list[Any]:
    """Read images.bin or .txt: the columns of `ColmapImages`, in its order."""
    columns = _call("read_images", path, _array([with_points2d], "u8"))
    ids, quats, translations, camera_ids, names, ends, offsets, points2d, point3d_ids = columns
    poses = [quats.reshape(-1, 4), translations.reshape(-1, 3)]
    return [ids, camera_ids, *poses, _texts(names, ends), offsets, points2d.reshape(-1, 2), point3d_ids]


def read_points(path: Path, with_tracks: bool) -> list[Array]:
    """Read points3D.bin or .txt: the columns of `ColmapPoints`, in its order."""
    columns = _call("read_points", path, _array([with_tracks], "u8"))
    ids, positions, colors, *others = columns
    return [ids, positions.reshape(-1, 3), colors.reshape(-1, 3), *others]


def read_ply(
    path: Path, first: int = 0, most: int = 2**64 - 1
) -> tuple[list[str], list[tuple[str, str]], int, Array, int]:
    """Read up to `most` vertices of a PLY from number `first` on.

    Returns comments, names and numpy types, number of vertices read, their packed rows (uint8), and the
    number of vertices of the file.
    """
    numbers = (_array([first], "u8"), _array([most], "u8"))
    comments, comment_ends, names, name_ends, types, type_ends, count, rows, total = _call(
        "read_ply", path, *numbers
    )
    properties = list(zip(_texts(names, name_ends), _texts(types, type_ends), strict=True))
    return _texts(comments, comment_ends), properties, int(count[0]), rows, int(total[0])


def read_image_file(path: Path) -> tuple[Array, dict[str, Any]]:
    """Read the bytes of an image file, uint8, and `read_image_header` of it.

    A JPEG or PNG whose damage a decoder would conceal is refused (csrc/io/image_file.h).
    """
    header, data = _call("read_image_file", path)
    return data, json.loads(header.tobytes())


def read_image_header(data: bytes | Array, name: Path) -> dict[str, Any]:
    """Return what the header of an image says: the fields of `ImageHeader` in csrc/io/image_file.h."""
    (header,) = _call("read_image_header", data, name)
    found: dict[str, Any] = json.loads(header.tobytes())
    return found


def tiff_as_stored(data: bytes | Array, name: Path) -> bytes | Array:
    """Return a TIFF that OpenCV decodes as it is stored (csrc/io/image_file.h)."""
    (changed,) = _call("tiff_as_stored", data, name)
    return changed if len(changed) else data


def encode_qoi(rgb: Array) -> Array:
    """Return a picture, uint8 [H, W, 3], as the bytes of a QOI file."""
    if rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError("qoi: the image must be [H, W, 3]")
    (file,) = _call(
        "encode_qoi", _array(rgb, "u1"), _array(rgb.shape[:1], "u8"), _array(rgb.shape[1:2], "u8")
    )
    return file


def decode_qoi(data: bytes | Array) -> Array:
    """Return the picture in a QOI file, uint8 [H, W, 3]."""
    size, rgb = _call("decode_qoi", data)
    return rgb.reshape(int(size[0]), int(size[1]), 3)


def set_flag(flags: npt.NDArray[np.uint8], index: int) -> None:
    """Set a flag in shared memory: who sees it also sees all that was written before."""
    _call("set_flag", flags[index : index + 1], keeps_gil=True)


def flag_is_set(flags: npt.NDArray[np.uint8], index: int) -> bool:
    """Tell whether `set_flag` was called for a flag."""
    return bool(_call("flag_is_set", flags[index : index + 1], keeps_gil=True)[0][0])
