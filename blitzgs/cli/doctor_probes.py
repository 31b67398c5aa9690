# SPDX-License-Identifier: Apache-2.0
"""What `blitzgs doctor` tries in processes of its own, because it may crash or hang there.

Each probe prints one line of JSON: `python -m blitzgs.cli.doctor_probes NAME ARGUMENTS`.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor


REPORT = "report this with `blitzgs doctor --json`"
REINSTALL = "pip install --force-reinstall --no-deps blitzgs (in a checkout: make build)"
_WIDTH, _HEIGHT, _COUNT = 48, 32, 60
# The largest errors of the small rendering in float32, and of its gradients relative to the largest of each.
_IMAGE_ERROR, _GRADIENT_ERROR = 1e-5, 1e-3
_DISK_BYTES, _SLOW_DISK_MB_S = 64 << 20, 50


def found(state: str, text: str, remedy: str = "", **values: Any) -> dict[str, Any]:
    """Return what a look finds; see `blitzgs.cli.doctor.Line`."""
    return {"state": state, "text": text, "remedy": remedy, "values": values}


def torch_() -> dict[str, Any]:
    """Return what torch says of itself and of the GPUs."""
    import torch

    gpus = range(torch.cuda.device_count() if torch.cuda.is_available() else 0)

    def gpu(i: int) -> dict[str, Any]:
        free, total = torch.cuda.mem_get_info(i)
        return {
            "name": torch.cuda.get_device_name(i),
            "architecture": "sm_{}{}".format(*torch.cuda.get_device_capability(i)),
            "bytes": total,
            "free_bytes": free,
            "peers": [j for j in gpus if j != i and torch.cuda.can_device_access_peer(i, j)],
        }

    return {
        "version": torch.__version__,
        "cuda": torch.version.cuda,
        "threads": torch.get_num_threads(),
        "gpus": list(map(gpu, gpus)),
        "nccl": ".".join(map(str, torch.cuda.nccl.version())) if len(gpus) else None,
    }


def library(name: str, *architectures: str) -> dict[str, Any]:
    """Load a library, and compare what it was built for with the GPUs' architectures."""
    import ctypes

    from blitzgs import _built

    path = _built.LIBRARY_DIR / f"libblitzgs_{name}.so"
    if not path.exists():
        return found("missing", str(path), REINSTALL)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    text = f"{path.stat().st_size / 1e6:.1f} MB, sha256 {digest}"
    if name == "io":
        from blitzgs.formats import native

        return found("ok", text, sha256=digest, models=len(native.camera_models()))
    import torch

    torch.ops.load_library(str(path))
    ops = _built.schema_digest(path)
    if _built.REGISTRATION.exists() and ops != _built.source_digest(_built.REGISTRATION):
        raise ImportError(f"{path} was built before the ops changed (csrc/registration.cpp is another)")
    if name == "cpu":
        return found("ok", text, sha256=digest, ops=ops)
    build = ctypes.CDLL(str(path)).blitzgs_cuda_build
    build.restype = ctypes.c_char_p
    cuda, built = build().decode().split(" ")
    text, values = f"{text}, CUDA {cuda} for {built}", {"cuda": cuda, "architectures": built, "ops": ops}
    if others := foreign(built, architectures):
        remedy = "the driver compiles the kernels at the first use; to avoid it: make build"
        return found("warning", f"{text}, not for {others[0]}", remedy, **values)
    return found("ok", text, sha256=digest, **values)


def foreign(built: str, architectures: Sequence[str]) -> list[str]:
    """Return the architectures that a library was not built for, of GPUs such as "sm_90"."""
    known = architectures if built == "native" else {f"sm_{number}" for number in re.findall(r"\d+", built)}
    return [name for name in architectures if name not in known]


def render(device: str) -> dict[str, Any]:
    """Render a small scene and differentiate it, and compare both with the float64 reference."""
    import torch

    from blitzgs.reference.render import render as render_reference

    tensors = [tensor.to(device).requires_grad_() for tensor in _scene()]
    viewmat, K = (tensor.to(device) for tensor in _camera(0))
    begin = time.perf_counter()
    image = _rendered(tensors, viewmat, K, False)[0].double().cpu()
    leaves = [tensor.double().requires_grad_() for tensor in _scene()]
    by_definition: Any = render_reference
    reference = by_definition(*leaves, *_camera(0), _WIDTH, _HEIGHT, sh_degree=1)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    weights[reference.cut] = 0  # where rounding decides whether a Gaussian counts
    ours = torch.autograd.grad((image * weights).sum(), tensors)
    exact = torch.autograd.grad((reference.image * weights).sum(), leaves)
    gradients = [(a.double().cpu() - b).abs().max() / b.abs().max() for a, b in zip(ours, exact, strict=True)]
    seconds = time.perf_counter() - begin
    error = (image - reference.image).detach().abs()[~reference.cut].max()
    return rendered(float(error), float(max(gradients)), seconds)


def rendered(image_error: float, gradient_error: float, seconds: float) -> dict[str, Any]:
    """Judge a rendering by its largest errors."""
    good = image_error <= _IMAGE_ERROR and gradient_error <= _GRADIENT_ERROR
    text = f"error of the image {image_error:.1e}, of gradients {gradient_error:.1e} ({seconds:.1f} s)"
    state, remedy = ("ok", "") if good else ("failed", REPORT)
    return found(state, text, remedy, image_error=image_error, gradient_error=gradient_error, seconds=seconds)


def exchange(device: str, rank: str, port: str) -> dict[str, Any]:
    """Render one view with Gaussians divided between two ranks; return how it differs from one rank's."""
    import torch

    from blitzgs.distributed.group import Ranks

    os.environ.update(RANK=rank, LOCAL_RANK=rank, WORLD_SIZE="2", LOCAL_WORLD_SIZE="2")
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=port)
    with Ranks.from_environment(device, timeout_seconds=30) as ranks:
        viewmat, K, *scene = (tensor.to(ranks.device) for tensor in (*_camera(int(rank)), *_scene()))
        half = slice(0, 20) if rank == "0" else slice(20, None)
        begin = time.perf_counter()
        together = _rendered([tensor[half].contiguous() for tensor in scene], viewmat, K, True)
        seconds = time.perf_counter() - begin
        alone = _rendered(scene, viewmat, K, False)
        ranks.barrier()
        return {
            "differing_values": int((together != alone).sum()),
            "covered": float((alone > 0).double().mean()),
            "seconds": seconds,
            "backend": torch.distributed.get_backend(),
        }


def nccl(port: str) -> dict[str, Any]:
    """Sum over one rank with NCCL, which is what one GPU can try."""
    import torch

    torch.distributed.init_process_group("nccl", f"tcp://127.0.0.1:{port}", world_size=1, rank=0)
    values = torch.arange(8.0, device="cuda")
    torch.distributed.all_reduce(values)
    total = float(values.sum())
    torch.distributed.destroy_process_group()
    return found("ok", "one GPU: it sums") if total == 28.0 else found("failed", "one GPU: a wrong sum")


def disk(folder: str) -> dict[str, Any]:
    """Write and read a file."""
    data = os.urandom(1 << 20)
    with tempfile.TemporaryFile(dir=folder) as file:
        begin = time.perf_counter()
        for _ in range(_DISK_BYTES // len(data)):
            file.write(data)
        file.flush()
        os.fsync(file.fileno())
        written = time.perf_counter()
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        file.seek(0)
        count = 0
        while block := file.read(1 << 20):
            count += block == data
        read = time.perf_counter()
    if count * len(data) != _DISK_BYTES:
        raise OSError(f"{folder}: what was written is not what is read")
    return measured(folder, _DISK_BYTES / (written - begin) / 1e6, _DISK_BYTES / (read - written) / 1e6)


def measured(folder: str, write_mb_s: float, read_mb_s: float) -> dict[str, Any]:
    """Judge a disk by its megabytes a second."""
    free_bytes = shutil.disk_usage(folder).free
    text = f"{folder}: writes {write_mb_s:.0f} and reads {read_mb_s:.0f} MB/s, {free_bytes / 1e9:.0f} GB free"
    slow = min(write_mb_s, read_mb_s) < _SLOW_DISK_MB_S
    state, remedy = ("warning", "keep captures and runs on a local disk") if slow else ("ok", "")
    return found(state, text, remedy, write_mb_s=write_mb_s, read_mb_s=read_mb_s, free_bytes=free_bytes)


def _scene() -> list[Tensor]:
    """Return the means, quats, scales, opacities and SH coefficients of some Gaussians, float32."""
    import torch

    generator = torch.Generator().manual_seed(4)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(_COUNT, *shape, generator=generator)

    means = torch.cat([uniform(-1.2, 1.2, 1), uniform(-0.8, 0.8, 1), uniform(2, 4, 1)], dim=1)
    return [means, uniform(-1, 1, 4), uniform(0.05, 0.3, 3), uniform(0.2, 0.9), uniform(-0.3, 0.8, 4, 3)]


def _camera(number: int) -> tuple[Tensor, Tensor]:
    import torch

    viewmat = torch.eye(4)
    viewmat[0, 3] = 0.1 * number
    return viewmat, torch.tensor([[40.0, 0, _WIDTH / 2], [0, 40.0, _HEIGHT / 2], [0, 0, 1]])


def _rendered(scene: list[Tensor], viewmat: Tensor, K: Tensor, distributed: bool) -> Tensor:
    import blitzgs

    render: Any = blitzgs.rasterization
    view = (viewmat[None], K[None], _WIDTH, _HEIGHT)
    return render(*scene, *view, sh_degree=1, distributed=distributed)[0]


_PROBES = {probe.__name__: probe for probe in (torch_, library, render, exchange, nccl, disk)}

if __name__ == "__main__":
    print(json.dumps(_PROBES[sys.argv[1]](*sys.argv[2:])))
