# SPDX-License-Identifier: Apache-2.0
"""Small scenes and models, gradients, a reader of GLB, and errors that fail for NaN and wrong shapes."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import blitzgs
from blitzgs.capture import colmap
from blitzgs.formats.gaussians import Gaussians
from blitzgs.formats.models import FORMATS
from blitzgs.frame.render import Frame, backward_splats
from blitzgs.ops.photometric import report_
from blitzgs.reference import ReferenceImage, render
from blitzgs.runs.checkpoint import Saving
from blitzgs.runs.export import Exported, export
from blitzgs.runs.folder import Model
from blitzgs.runs.source import source_of
from blitzgs.table.table import GaussianTable
from blitzgs.util.rotations import quaternions

PARAMETERS = ("means", "quats", "scales", "opacities", "colors", "viewmats")

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
# Where the kernels run, and in which dtype.
BACKENDS = [
    pytest.param(("cpu", torch.float64), id="cpu-float64"),
    pytest.param(("cpu", torch.float32), id="cpu-float32"),
    pytest.param(("cuda", torch.float32), id="cuda-float32", marks=pytest.mark.cuda),
]


@dataclass
class Scene:
    """Activated Gaussians and the cameras that see them; everything [N, ...] or [C, ...]."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor  # SH [N, 16, 3]
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    sh_degree: int | None = 3

    def to(self, dtype: torch.dtype, device: str = "cpu") -> Scene:
        tensors = {k: v.to(device, dtype) for k, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **tensors)

    def leaves(self) -> Scene:
        """Return a copy whose PARAMETERS require gradients."""
        return replace(self, **{k: getattr(self, k).detach().clone().requires_grad_() for k in PARAMETERS})

    def parameters(self) -> list[Tensor]:
        """Return PARAMETERS."""
        return [getattr(self, name) for name in PARAMETERS]

    def gradients(self) -> list[Tensor | None]:
        """Return the gradients of PARAMETERS."""
        return [tensor.grad for tensor in self.parameters()]

    def view(self, number: int) -> Scene:
        """Return the scene with one of its cameras."""
        return replace(self, viewmats=self.viewmats[number, None], Ks=self.Ks[number, None])

    def arguments(self) -> tuple:
        """Return the positional arguments of `blitzgs.rasterization`."""
        return (
            self.means, self.quats, self.scales, self.opacities, self.colors, self.viewmats, self.Ks,
            self.width, self.height,
        )  # fmt: skip


def rasterize_scene(scene: Scene, **options):
    """Call `blitzgs.rasterization` for a scene; options override the scene's."""
    return blitzgs.rasterization(*scene.arguments(), **{"sh_degree": scene.sh_degree, **options})


def random_scene(
    n: int = 60,
    cameras: int = 2,
    width: int = 40,
    height: int = 32,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
    scale: float = 0.12,
    device: str = "cpu",
) -> Scene:
    """Gaussians in a unit ball seen from a few units away, with off-centre principal points."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(n, 3)
    means = (
        means / means.norm(dim=1, keepdim=True) * torch.rand(n, 1, generator=generator, dtype=torch.float64)
    )
    Ks = torch.zeros(cameras, 3, 3, dtype=torch.float64)
    Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 2, 2] = 1.1 * width, 1.15 * width, 1.0
    Ks[:, 0, 2], Ks[:, 1, 2] = 0.45 * width, 0.56 * height
    viewmats = [orbit_camera(2.0 * math.pi * c / max(cameras, 1) + 0.3) for c in range(cameras)]
    return Scene(
        means,
        normal(n, 4) * 3.0,
        scale * torch.exp(0.6 * normal(n, 3)),
        torch.sigmoid(normal(n)),
        0.4 * normal(n, 16, 3),
        torch.stack(viewmats) if viewmats else torch.zeros(0, 4, 4, dtype=torch.float64),
        Ks,
        width,
        height,
    ).to(dtype, device)


def orbit_camera(angle: float, distance: float = 3.0, lift: float = 0.4) -> Tensor:
    """World-to-camera [4, 4] that looks at the origin from a circle around it (z forward, y down)."""
    eye = torch.tensor([math.sin(angle), -lift, -math.cos(angle)], dtype=torch.float64) * distance
    forward = -eye / eye.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    return viewmat


def look_at_origin(position) -> np.ndarray:
    """World-to-camera [4, 4] at a position [3], float64, with z up in the world."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def write_colmap(folder: Path, camera: tuple, names: list, poses: np.ndarray, points, colors) -> None:
    """Write a COLMAP model without observations.

    `camera`: width, height, fx, fy, cx, cy of a pinhole camera. `poses`: world-to-camera [N, 4, 4].
    """
    count, (width, height, *params) = len(names), camera
    images = colmap.ColmapImages(
        ids=np.arange(1, count + 1, dtype=np.uint32),
        camera_ids=np.ones(count, dtype=np.uint32),
        quats=quaternions(torch.from_numpy(poses[:, :3, :3])).numpy(),
        translations=poses[:, :3, 3],
        names=names,
        point2d_offsets=np.zeros(count + 1, dtype=np.uint64),
    )
    cloud = colmap.ColmapPoints(
        ids=np.arange(1, len(points) + 1, dtype=np.int64),
        positions=points,
        colors=colors,
        errors=np.ones(len(points)),
        track_offsets=np.zeros(len(points) + 1, dtype=np.uint64),
    )
    cameras = [colmap.ColmapCamera(1, "PINHOLE", width, height, np.array(params))]
    colmap.write_model(folder, colmap.ColmapModel(cameras, images, cloud))


def reference_images(scene: Scene, backgrounds: Tensor | None = None, **options) -> list[ReferenceImage]:
    """Render each view of the scene by definition, in float64."""
    return [
        render(
            scene.means,
            scene.quats,
            scene.scales,
            scene.opacities,
            scene.colors,
            scene.viewmats[c],
            scene.Ks[c],
            scene.width,
            scene.height,
            sh_degree=scene.sh_degree,
            background=None if backgrounds is None else backgrounds[c],
            **options,
        )
        for c in range(len(scene.viewmats))
    ]


def ssim_map(x: Tensor, y: Tensor, padding: int = 5) -> Tensor:
    """SSIM of images [B, H, W, 3] by its formula and torch's convolution in float64; a map of their size.

    Args:
        x: differentiable.
        y: of the same shape.
        padding: zeros around the images; without, the map is smaller by 5 pixels at each side.
    """
    x, y = (t.double().permute(0, 3, 1, 2) for t in (x, y))
    line = torch.exp(-((torch.arange(11, dtype=torch.float64, device=x.device) - 5) ** 2) / 4.5)
    line = (line / line.sum()).expand(3, 1, 1, 11)
    conv = partial(torch.nn.functional.conv2d, groups=3)

    def blur(t: Tensor) -> Tensor:
        return conv(conv(t, line, padding=(0, padding)), line.mT, padding=(padding, 0))

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    top = (2 * mx * my + 0.01**2) * (2 * cov + 0.03**2)
    return (top / ((mx * mx + my * my + 0.01**2) * (vx + vy + 0.03**2))).permute(0, 2, 3, 1)


def on_threads(call: Callable[[], Any], counts: Iterable[int] = (1, 2, 3)) -> list[Any]:
    """Return what a call returns with each of these numbers of torch's threads."""
    before, results = torch.get_num_threads(), []
    try:
        for count in counts:
            torch.set_num_threads(count)
            results.append(call())
    finally:
        torch.set_num_threads(before)
    return results


@contextmanager
def other_defaults() -> Iterator[None]:
    """Give torch another default dtype and device, on which what names none of its own cannot be used."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"):
            yield
    finally:
        torch.set_default_dtype(before)


def refused(error: type[Exception], text: str, call: Callable, /, *given: Any, **named: Any) -> None:
    """Check that a call raises an error of this kind, whose message the regular expression matches."""
    with pytest.raises(error, match=text):
        call(*given, **named)


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """Return max |actual - expected| / max |expected|; infinite for NaN or anything else not finite."""
    assert actual.shape == expected.shape, f"shapes differ: {list(actual.shape)}, {list(expected.shape)}"
    if expected.numel() == 0:
        return 0.0
    actual, expected = actual.detach().double().cpu(), expected.detach().double().cpu()
    difference = (actual - expected).abs().max().item()
    size = expected.abs().max().item()
    if not (math.isfinite(difference) and math.isfinite(size)):
        return math.inf
    if size == 0.0:
        return 0.0 if difference == 0.0 else math.inf
    return difference / size


def agree(actual: Iterable[Tensor | None], expected: Iterable[Tensor | None], bound: float) -> None:
    """Check that tensors have relative errors below a bound, one by one, or are None alike."""
    for number, (own, wanted) in enumerate(zip(actual, expected, strict=True)):
        assert (own is None) == (wanted is None), number
        assert own is None or relative_error(own, wanted) < bound, number


def image_error(actual: Tensor, expected: Tensor, cut: Tensor, most_cut: float = 0.1) -> float:
    """Return max |actual - expected| over the pixels that are not cut; infinite for NaN anywhere.

    Fails when more than the share `most_cut` of the pixels is cut: then there is nothing left to compare.
    """
    assert actual.shape == expected.shape, f"shapes differ: {list(actual.shape)}, {list(expected.shape)}"
    share = cut.double().mean().item()
    assert share <= most_cut, f"{share:.1%} of the pixels are on a cut, more than {most_cut:.1%}"
    actual, expected = actual.detach().double().cpu(), expected.detach().double().cpu()
    if not (actual.isfinite().all() and expected.isfinite().all()):
        return math.inf
    return (actual - expected)[~cut].abs().max().item() if (~cut).any() else 0.0


def sum_parts(parts: Tensor) -> tuple[Tensor, Tensor]:
    """Add up a loss's parts, float64 [B, K, 2], to the sums of |x - y| and of SSIM, float32 [B] each."""
    target = parts.new_empty(2 * len(parts), dtype=torch.float32)
    report_(parts, None, (0, 0), 0, 1, [target])
    l1, ssim = target.view(2, -1)
    return l1, ssim


def save_checkpoint(*arguments: Any, **options: Any) -> Path:
    """Write a checkpoint and delete older ones, as `Saving` and with its arguments; return its folder."""
    saving = Saving(*arguments, **options)
    path = saving.finish()
    if saving.deleting is not None:
        saving.deleting.join()
    return path


def export_ply(model: Model, path: Path, coordinates: str = "auto", crs: str = "") -> Exported:
    """Write a model of a run in INRIA's layout."""
    return export(source_of(model), model.space, FORMATS["ply"], path, coordinates, crs)


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


def glb_parts(path):
    """Return the JSON and the bytes of a GLB file."""
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
    return content, body


def read_glb(path):
    """Return the JSON and the attributes of the only primitive by name, by the glTF specification alone."""
    content, body = glb_parts(path)
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


def parameter_gradients(
    table: GaussianTable,
    frame: Frame,
    v_renders: Tensor,
    scale_reg: Tensor | None = None,
    opacity_reg: Tensor | None = None,
) -> list[Tensor]:
    """Return the gradients of the U visible Gaussians' parameters, from those of a frame's images.

    Training never stores them. The weights are those of `project_bwd_step_`.
    """
    gradients, projected = backward_splats(frame, v_renders), frame.projected
    options = frame.options.projection(frame.views)
    *parameters, _ = torch.ops.blitzgs.project_bwd(
        list(table.parameters), frame.views.viewmats, frame.views.Ks, scale_reg, opacity_reg,
        projected.camera_ids, projected.visible_ids, projected.splat_offsets, None, *options,
        list(gradients.parts), None, False,
    )  # fmt: skip
    return parameters
