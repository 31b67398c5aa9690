# SPDX-License-Identifier: Apache-2.0
"""Reads a finished run without the trainer: configuration, log, metrics, cameras and the model.

run = blitzgs.open_run("runs/city")
model = run.model("cuda")
image = model.render(run.cameras().cameras[0])     # float32 [H, W, 3]
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from blitzgs.call import rasterization
from blitzgs.config.fields import Config
from blitzgs.config.files import load_config
from blitzgs.distributed.group import Ranks, resolve_device
from blitzgs.runs import run_files, trained_model
from blitzgs.runs.cameras import RunCamera, RunCameras, checked_camera, load_cameras
from blitzgs.runs.log import records
from blitzgs.runs.trained_model import TrainedModel
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.view.gate import ModelGate, centres_of
from blitzgs.view.views import CameraLike, Space, ViewSet, render_options, viewmat
from blitzgs.view.visible import Subject


@dataclass(frozen=True, repr=False, eq=False)
class Model:
    """N trained Gaussians before activation, without optimiser state; lengths in trained units.

    A trained position is (capture position - space.offset) / space.unit.

    Attributes:
        means: float32 [N, 3].
        quats: float32 [N, 4], w, x, y, z, not normalised.
        scales: float32 [N, 3], logarithms.
        opacities: float32 [N], logits.
        sh: float32 [N, K, 3].
        level: octree levels, uint8 [N].
        lod: LOD gate of the model; None: views leave out no Gaussians.
        space: maps between the trained world and the capture's world.
        sh_degree: spherical-harmonics degree to evaluate.
        config: configuration of the run.
        images_seen: number of images that the model was trained on.
        exposures: gain and bias of each training photograph, [T, 2, 3]; None if the run has none.
        run: the run, whose cameras `render` takes by their indices; None: it takes only cameras.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    level: Tensor
    lod: ModelGate | None
    space: Space
    sh_degree: int
    config: Config
    images_seen: int
    exposures: Tensor | None = None
    run: RunFolder | None = None

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return (
            f"Model({len(self):,} Gaussians of SH degree {self.sh_degree} on {self.means.device}, "
            f"{self.images_seen:,} images seen)"
        )

    @torch.no_grad()
    def render(self, camera: CameraLike | int, render_mode: str = "RGB", alpha: bool = False) -> Tensor:
        """Render a view as the run's own evaluation does.

        Args:
            camera: any pinhole camera with a pose in the re-centred world, for example from
                `RunFolder.cameras` or `camera`; or the index of a camera of the run, for example from
                `RunFolder.cameras().test`.
            render_mode: "RGB", "D", "ED", "RGB+D" or "RGB+ED", as for `blitzgs.rasterization`; depths are in
                the capture's unit.
            alpha: whether the opacity of each pixel follows as the last channel.

        Returns:
            float32 [H, W, channels] on the model's device: colours (not clamped), depth, alpha.

        Raises:
            TypeError: `camera` is no camera.
            IndexError: the run has no camera of this index.
            ValueError: there is no such mode.
            NotEnoughMemoryError: the image does not fit into memory.
        """
        camera = self._camera(camera)
        kept, antialiased = self._kept(camera), self.config.model.antialiased
        images, alphas, _ = kept.splat([camera], antialiased, render_mode)
        if "D" in render_mode:
            images[..., -1] *= self.space.unit
        return torch.cat([images[0], alphas[0]], dim=-1) if alpha else images[0]

    def _camera(self, camera: CameraLike | int) -> CameraLike:
        """Return a camera, or that of the run with an index."""
        if isinstance(camera, (int, np.integer)) and not isinstance(camera, bool) and self.run is not None:
            cameras = self.run.cameras().cameras
            if not 0 <= camera < len(cameras):
                raise IndexError(f"camera {camera}: the run has the cameras 0 to {len(cameras) - 1}")
            return cameras[camera]
        if isinstance(camera, (int, np.integer)) or not all(
            hasattr(camera, name) for name in ("width", "height", "K", "world_to_camera")
        ):
            raise TypeError(
                "camera must be a camera, such as run.cameras().cameras[0] or model.camera(...), got "
                f"{camera!r} ({type(camera).__name__})"
            )
        return camera

    def _kept(self, camera: CameraLike) -> Model:
        """Return the Gaussians that the LOD gate keeps for a view, faded if levels are smooth."""
        if self.lod is None:
            return self
        pose = torch.from_numpy(viewmat(camera, self.space)).float().to(self.means.device)[None]
        rows = self.lod.rows(self.means, self.level, pose)
        columns = {name: getattr(self, name)[rows] for name in (*PARAMETERS, "level")}
        if self.lod.gate.smooth:
            weights = self.lod.gate.weights(columns["means"], columns["level"], centres_of(pose)[0])
            faded = columns["opacities"].double().sigmoid() * weights
            columns["opacities"] = faded.logit().float()
        return dataclasses.replace(self, **columns)

    def splat(
        self, cameras: list[CameraLike], antialiased: bool, render_mode: str = "RGB"
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Call `blitzgs.rasterization` for cameras of one size; return its images, alphas and meta."""
        options = render_options(self.config, self.space, self.sh_degree)
        views = ViewSet(cameras, self.space, self.means.device).pick(list(range(len(cameras))))
        return rasterization(
            self.means,
            self.quats,
            self.scales.exp(),
            self.opacities.sigmoid(),
            self.sh,
            views.viewmats,
            views.Ks,
            views.width,
            views.height,
            near_plane=options.near_plane,
            far_plane=options.far_plane,
            eps2d=options.eps2d,
            sh_degree=self.sh_degree,
            backgrounds=self.means.new_tensor([options.background] * len(cameras)),
            render_mode=render_mode,
            rasterize_mode="antialiased" if antialiased else "classic",
        )

    def camera(
        self, K: np.ndarray, world_to_camera: np.ndarray, width: int, height: int, name: str = "view"
    ) -> RunCamera:
        """Make a camera for `render` from a pose in the capture's own world.

        Args:
            K: intrinsics in pixels, [3, 3].
            world_to_camera: rigid pose, [4, 4].
            width: pixels, an integer from 1 to 2^20.
            height: pixels, an integer from 1 to 2^20.
            name: name of the view.

        Raises:
            ValueError: an argument has another shape or value; the message names it.
        """
        camera = checked_camera(name, width, height, K, world_to_camera)
        pose = camera.world_to_camera
        pose[:3, 3] += pose[:3, :3] @ np.array(self.space.offset)
        return camera


class RunFolder:
    """The folder of a run, made by `blitzgs train --out`."""

    def __init__(self, path: Path | str) -> None:
        """Open a folder (FileNotFoundError: it is not the folder of a run)."""
        self.path = Path(path)
        run_files.check_is_run(self.path)

    def __repr__(self) -> str:
        state = "finished" if (self.path / run_files.SUMMARY).exists() else "not finished"
        return f"RunFolder({str(self.path)!r}, {state})"

    def config(self) -> Config:
        """Return the configuration in the folder."""
        return load_config(self.path / run_files.CONFIG)

    def summary(self) -> dict[str, Any]:
        """Return the content of `summary.json`; empty if the run is not finished."""
        return self._json(self.path / run_files.SUMMARY)

    def log(self) -> list[dict[str, Any]]:
        """Return the records of the log, oldest first, without incomplete lines."""
        return list(records(self.path / run_files.LOG))

    def metrics(self) -> dict[str, dict[str, Any]]:
        """Return the evaluations: number of images seen, or split -> metrics, each view's under "views"."""
        files = sorted((self.path / run_files.EVALUATION).glob("*/metrics.json"))
        return {file.parent.name: self._json(file) for file in files}

    def cameras(self) -> RunCameras:
        """Return the cameras that the run was trained and measured with, as `load_cameras` does."""
        return load_cameras(self.path)

    def model(self, device: torch.device | str = "cpu", checkpoint: str | None = None) -> Model:
        """Return the model of the newest undamaged checkpoint, or of the one of a name.

        The optimiser's moments are read too, to apply pending steps; they are dropped before the model is
        copied to `device`.

        Args:
            device: "cpu", "cuda" or "cuda:N".
            checkpoint: name of its folder in RUN/checkpoints; None: the newest.

        Raises:
            ValueError: there is no such device.
            FileNotFoundError: there is no checkpoint yet.
            CheckpointError: all checkpoints are damaged.
        """
        chosen, _ = resolve_device(str(device), local_rank=0, local_world_size=1, share_gpus=False)
        with torch.device("cpu"):  # whatever the program's default device is
            found = trained_model.open_model(self.path, Ranks(), only=checkpoint)
            return dataclasses.replace(model_of(found, chosen), run=self)

    @staticmethod
    def _json(path: Path) -> dict[str, Any]:
        try:
            return cast(dict[str, Any], json.loads(path.read_text(encoding="utf-8")))
        except FileNotFoundError:
            return {}
        except ValueError as error:
            raise ValueError(f"{path} is damaged: {error}") from error


def subject_of(model: Model) -> Subject:
    """Return what views of a model are rendered from."""
    table = GaussianTable.of_parameters({name: getattr(model, name) for name in (*PARAMETERS, "level")})
    gate = None if model.lod is None else model.lod.gate
    options = render_options(model.config, model.space, model.sh_degree, gate)
    return Subject(table, options, model.space, model.lod)


def model_of(found: TrainedModel, device: torch.device) -> Model:
    """Return a trained model, whose rows have no pending steps, on a device."""
    columns: dict[str, Any] = {name: found.table[name].to(device) for name in (*PARAMETERS, "level")}
    return Model(
        **columns,
        lod=found.progress.model_gate(found.config, found.table, Ranks()),
        space=found.space,
        sh_degree=found.progress.sh_degree,
        config=found.config,
        images_seen=found.progress.step * found.config.schedule.batch_size,
        exposures=found.exposures,
    )


def open_run(path: Path | str) -> RunFolder:
    """Open the folder of a run for reading; see `RunFolder`.

    Raises:
        FileNotFoundError: the folder is not a run.
    """
    return RunFolder(path)
