# SPDX-License-Identifier: Apache-2.0
"""The files of a checkpoint: safetensors written column by column, and the manifest with digests.

The writer of the safetensors package needs the whole shard in host memory, and it neither computes a digest
nor syncs. For a shard of 100 million Gaussians, a second copy in memory and a second pass over the file would
be expensive.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from blitzgs.util.errors import WRONG_CONTENT, amount
from blitzgs.util.output import sync_to_disk, write_file

FORMAT = 2
MANIFEST = "manifest.json"
# What reading a damaged checkpoint may raise.
DAMAGE = (OSError, SafetensorError, *WRONG_CONTENT)


@dataclass
class Shard:
    """One file of a checkpoint: name, rows of the table in it, size and SHA-256."""

    file: str
    rows: int
    bytes: int
    sha256: str


@dataclass
class Manifest:
    """The files of a checkpoint, and its state."""

    shards: list[Shard]
    shared: Shard | None
    state: Mapping[str, Any]


def verified(path: Path, part: int = 0, parts: int = 1) -> Manifest:
    """Read the manifest of a checkpoint, and compare part of the files with their digests; see `DAMAGE`."""
    manifest = read_manifest(path)
    for shard in [*manifest.shards, *([manifest.shared] if manifest.shared else [])][part::parts]:
        file = path / shard.file
        if not file.exists():
            raise ValueError(f"{shard.file} is missing")
        if (size := file.stat().st_size) != shard.bytes:
            raise ValueError(f"{shard.file} has {size} bytes, the manifest says {shard.bytes}")
        if file_digest(file) != shard.sha256:
            raise ValueError(f"{shard.file} does not match its SHA-256")
        with opened(file) as columns:
            shapes = [columns.get_slice(name).get_shape() for name in columns.keys()]  # noqa: SIM118
        if shard is not manifest.shared and any(shape[:1] != [shard.rows] for shape in shapes):
            raise ValueError(f"{shard.file} has columns of other lengths than the manifest's {shard.rows}")
    return manifest


def read_manifest(path: Path) -> Manifest:
    """Read the manifest of a checkpoint, whose files may be damaged; see `DAMAGE`."""
    try:
        content = json.loads((path / MANIFEST).read_text())
    except FileNotFoundError:
        raise ValueError(f"{MANIFEST} is missing") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{MANIFEST} is not valid JSON ({error})") from error
    if content["format"] not in (1, FORMAT):
        raise ValueError(f"{MANIFEST} has format {content['format']}, this version reads 1 and {FORMAT}")
    # Format 1 had no digest of the manifest.
    if content["format"] != 1 and content.pop("sha256") != _digest(content):
        raise ValueError(f"{MANIFEST} does not match its own SHA-256")
    shared = content.get("shared")
    shards = [Shard(**shard) for shard in content["shards"]]
    if not shards:
        raise ValueError(f"{MANIFEST} names no files")
    if not isinstance(content["state"], dict):
        raise ValueError(f"{MANIFEST} has no state")
    return Manifest(shards, None if shared is None else Shard(**shared), content["state"])


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def finish(unfinished: Path, path: Path, manifest: Manifest) -> None:
    """Write the manifest beside the shards and give the folder its final name, each step synced."""
    missing = [shard.file for shard in manifest.shards if not (unfinished / shard.file).exists()]
    if missing:
        raise OSError(f"{', '.join(missing)} not in {unfinished}: every rank must see the same file system")
    content = {"format": FORMAT, "world_size": len(manifest.shards)} | asdict(manifest)
    content = json.loads(json.dumps(content))  # tuples become lists: what is read back has the same digest
    write_file(unfinished / MANIFEST, json.dumps(content | {"sha256": _digest(content)}, indent=1))
    unfinished.rename(path)
    sync_to_disk(path.parent)


_DTYPES = {
    torch.float64: "F64", torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16",
    torch.int64: "I64", torch.int32: "I32", torch.int16: "I16", torch.int8: "I8", torch.uint8: "U8",
    torch.bool: "BOOL",
}  # fmt: skip
_CHUNK_BYTES = 64 << 20


def write_shard(path: Path, columns: Mapping[str, Tensor]) -> tuple[int, str]:
    """Write and sync columns, on any device; return the size in bytes and the SHA-256 in hexadecimal.

    OSError: also if the free space is too small.
    """
    # Widest elements first, so that every column starts at a multiple of its element size.
    names = sorted(columns, key=lambda name: (-columns[name].element_size(), name))
    header, offset = {}, 0
    for name in names:
        column, begin, offset = columns[name], offset, offset + columns[name].nbytes
        shape = {"dtype": _DTYPES[column.dtype], "shape": list(column.shape)}
        header[name] = shape | {"data_offsets": [begin, offset]}
    if (free := shutil.disk_usage(path.parent).free) < offset:
        text = f"{amount(offset)} are needed and {amount(free)} are free"
        raise OSError(errno.ENOSPC, text, str(path.parent))
    head = json.dumps(header).encode()
    head += b" " * (-len(head) % 8)
    digest = hashlib.sha256()
    # The digest takes as long as writing. It is computed while the data are written and the next are fetched.
    with open(path, "wb") as file, ThreadPoolExecutor(1, "digest") as thread:
        hashed: Future[None] | None = None

        def put(data: bytes | memoryview) -> None:
            nonlocal hashed
            if hashed is not None:
                hashed.result()
            hashed = thread.submit(digest.update, data)
            file.write(data)

        put(len(head).to_bytes(8, "little"))
        put(head)
        for name in names:
            flat = columns[name].detach().contiguous().view(-1).view(torch.uint8)
            for part in flat.split(_CHUNK_BYTES):
                put(memoryview(part.cpu().numpy()))
        file.flush()
        os.fsync(file.fileno())
        size = file.tell()
    return size, digest.hexdigest()


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a safetensors file as its package does, also if the path is not valid UTF-8."""
    with open(path, "rb") as file:
        is_text = os.fsencode(path).decode(errors="replace") == str(path)
        with safe_open(path if is_text else f"/proc/self/fd/{file.fileno()}", "pt") as columns:
            yield columns


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()
