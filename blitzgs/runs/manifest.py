# SPDX-License-Identifier: Apache-2.0
"""The manifest of a checkpoint: its files with their digests, and the training state."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from blitzgs.runs.shard_file import file_digest
from blitzgs.util.output import sync_to_disk

FORMAT = 2
MANIFEST = "manifest.json"
# What reading a damaged checkpoint may raise.
DAMAGE = (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError)


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
    state: dict[str, Any]


def verified(path: Path, part: int = 0, parts: int = 1) -> Manifest:
    """Read the manifest of a checkpoint, and compare part of the files with their digests; see `DAMAGE`."""
    manifest = _read_manifest(path)
    for shard in [*manifest.shards, *([manifest.shared] if manifest.shared else [])][part::parts]:
        _verify(path, shard)
    return manifest


def _read_manifest(path: Path) -> Manifest:
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
    return Manifest(shards, None if shared is None else Shard(**shared), content["state"])


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _verify(path: Path, shard: Shard) -> None:
    file = path / shard.file
    if not file.exists():
        raise ValueError(f"{shard.file} is missing")
    if file.stat().st_size != shard.bytes:
        raise ValueError(f"{shard.file} has {file.stat().st_size} bytes, the manifest says {shard.bytes}")
    if file_digest(file) != shard.sha256:
        raise ValueError(f"{shard.file} does not match its SHA-256")


def finish(
    unfinished: Path,
    path: Path,
    shards: list[Shard],
    shared: Shard | None,
    state: Mapping[str, Any],
    world_size: int,
    reached: Callable[[str], None],
) -> None:
    """Write the manifest beside the shards and give the folder its final name, each step synced."""
    missing = [shard.file for shard in shards if not (unfinished / shard.file).exists()]
    if missing:
        raise OSError(f"{', '.join(missing)} not in {unfinished}: every rank must see the same file system")
    content = {
        "format": FORMAT,
        "world_size": world_size,
        "shards": [asdict(shard) for shard in shards],
        "shared": None if shared is None else asdict(shared),
        "state": dict(state),
    }
    content = json.loads(json.dumps(content))  # tuples become lists: what is read back has the same digest
    with open(unfinished / MANIFEST, "w") as file:
        json.dump(content | {"sha256": _digest(content)}, file, indent=1)
        reached("manifest written")
        file.flush()
        os.fsync(file.fileno())
    sync_to_disk(unfinished)
    reached("manifest synced")
    unfinished.rename(path)
    reached("renamed")
    sync_to_disk(path.parent)
    reached("finished")
