# SPDX-License-Identifier: Apache-2.0
"""Sizes of a run's model in all formats, and how near the renders of the files are to the run's own.

python benchmarks/bm_formats.py RUN --json formats.json

PSNR is that of the held-out views rendered from the file, against those rendered from the run. With --memory,
each export is a command of its own, and what counts is the memory that it and its processes have for
themselves at most, without pages of files; RUN may be a PLY file.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import torch
from harness import make_parser, write_json

from blitzgs.distributed.group import Ranks
from blitzgs.formats.gaussians import Gaussians
from blitzgs.formats.models import FORMATS, read_gaussians
from blitzgs.runs.evaluation import _psnr
from blitzgs.runs.export import export
from blitzgs.runs.folder import open_run
from blitzgs.runs.source import source_of
from blitzgs.runs.world import trained_columns
from blitzgs.table.table import PARAMETERS
from tests.helpers import read_glb


def read(path: Path) -> Gaussians:
    """Read a model file, also GLB, which has activated scales and opacities."""
    if path.suffix != ".glb":
        return read_gaussians(path)
    content, found = read_glb(path)
    columns = {name.rpartition(":")[2]: torch.tensor(values) for name, values in found.items()}
    sh = [column for name, column in columns.items() if name.startswith("SH_DEGREE")]
    return Gaussians(
        means=columns["POSITION"], quats=columns["ROTATION"][:, [3, 0, 1, 2]], scales=columns["SCALE"].log(),
        opacities=columns["OPACITY"][:, 0].logit(1e-7), sh=torch.stack(sh, dim=1),
        comments=content["asset"]["extras"]["comments"],
    )  # fmt: skip


def memory(model: Path) -> list[dict[str, object]]:
    rows = []
    kinds = {name: kind.suffix for name, kind in FORMATS.items()} | {"html": ".html", "tiles": ""}
    for name, suffix in kinds.items():
        with tempfile.TemporaryDirectory() as folder:
            path, begin, most = Path(folder) / f"model{suffix}", time.perf_counter(), 0
            command = [sys.executable, "-m", "blitzgs", "export", str(model), f"--{name}", str(path)]
            process = subprocess.Popen(command)
            while process.poll() is None:
                family = [process.pid, *(child.pid for child in psutil.Process(process.pid).children(True))]
                most = max(most, sum(map(own_bytes, family)))
                time.sleep(0.2)
            seconds = time.perf_counter() - begin
            files = [file for file in (path, *path.rglob("*")) if file.is_file()]
            size = sum(file.stat().st_size for file in files)
            rows.append({"format": name, "seconds": seconds, "memory": most, "bytes": size})
            print(rows[-1], flush=True)
    return rows


def own_bytes(process: int) -> int:
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:  # it has ended
        return 0
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith(("RssAnon", "RssShmem")))


def main() -> int:
    parser = make_parser(__doc__, device=None)
    parser.add_argument("run", type=Path)
    parser.add_argument("--memory", action="store_true")
    args = parser.parse_args()
    if args.memory:
        rows = memory(args.run)
        write_json(args.json, "cpu", memory=rows)
        return 0
    run = open_run(args.run)
    # Views without the gate of the levels, which most formats cannot hold.
    model = dataclasses.replace(run.model(), lod=None)
    cameras = run.cameras()
    views = [cameras.cameras[index] for index in cameras.test]
    own = [model.render(view).clamp(0, 1).double() for view in views]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, kind in FORMATS.items():
            path = Path(folder) / f"model-{name}{kind.suffix}"
            begin = time.perf_counter()
            export(source_of(model), model.space, kind, path)
            seconds = time.perf_counter() - begin
            found = read(path)
            columns = trained_columns(found, model.space, Ranks())
            other = dataclasses.replace(
                model,
                **{key: columns[key] for key in (*PARAMETERS, "level")},
                sh_degree=min(model.sh_degree, found.degree),
            )
            psnr = [
                _psnr(other.render(view).clamp(0, 1).double(), image)
                for view, image in zip(views, own, strict=True)
            ]
            size = path.stat().st_size
            rows.append(
                {
                    "format": name,
                    "bytes": size,
                    "bytes_per_gaussian": size / len(model),
                    "psnr": sum(psnr) / len(psnr),
                    "seconds": seconds,
                }
            )
            print(rows[-1], flush=True)
    about = {"gaussians": len(model), "sh_degree": model.sh_degree, "views": len(views)}
    write_json(args.json, "cpu", **about, formats=rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
