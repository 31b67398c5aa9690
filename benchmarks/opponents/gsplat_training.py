# SPDX-License-Identifier: Apache-2.0
"""Trains with gsplat's density strategies, unchanged from its wheel, over `blitzgs.rasterization`.

Learning rates, initialisation, schedule, loss weights and the scene's unit are those of the trainer in
gsplat's examples (`simple_trainer.py`, 1.5.3). This trainer differs from it in three points:

- Rendering and loss use our kernels, and photographs are on the device before the clock starts. Times are
  therefore those of gsplat's algorithm with our kernels, not gsplat's own.
- The SSIM of the loss is zero-padded at the image's edge, as in evaluations. gsplat's trainer leaves out the
  windows that extend beyond the edge.
- DefaultStrategy 1.5.3 announces a reset of opacities every 3,000 steps and never makes one, because `step %
  reset_every == 0 & step > 0` compares with `0 & step`. Versions before and after it make the resets. With
  `reset`, this trainer calls gsplat's own `reset_opa` at those steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from blitzgs import quat_scale_to_covar_preci, rasterization, relocate
from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.capture import Capture
from blitzgs.capture.images import ImageStore
from blitzgs.formats.gaussians import SH_C0
from blitzgs.frame.render import RenderOptions
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.ops.photometric import photometric_loss
from blitzgs.table.table import GaussianTable
from blitzgs.view.views import Space, ViewSet

STRATEGIES = ("default", "default-reset", "mcmc")


@dataclass(frozen=True)
class GsplatOptions:
    """The trainer's options under gsplat's names, with its defaults; None: the strategy's own default.

    Attributes:
        steps: length of the training; the strategy's own times do not follow it.
        steps_scaler: multiplies every time, also those of the strategy.
        reset: reset opacities where DefaultStrategy 1.5.3 fails to.
        cap_max: largest number of Gaussians of MCMCStrategy.
    """

    steps: int = 30_000
    steps_scaler: float = 1.0
    reset: bool = False
    cap_max: int = 1_000_000
    absgrad: bool = False
    grow_grad2d: float | None = None
    noise_lr: float | None = None
    sh_degree: int = 3
    sh_degree_interval: int = 1_000
    init_opa: float = 0.1
    init_scale: float = 1.0
    opacity_reg: float = 0.0
    scale_reg: float = 0.0
    ssim_lambda: float = 0.2
    near_plane: float = 0.01
    far_plane: float = 1e10
    packed: bool = False
    antialiased: bool = False
    means_lr: float = 1.6e-4
    scales_lr: float = 5e-3
    opacities_lr: float = 5e-2
    quats_lr: float = 1e-3
    sh0_lr: float = 2.5e-3
    shN_lr: float = 2.5e-3 / 20  # noqa: N815

    @classmethod
    def of(cls, strategy: str, changes: dict[str, Any]) -> GsplatOptions:
        """Return the defaults for a strategy with some changes (ValueError: a name or type is wrong)."""
        values: dict[str, Any] = {"reset": strategy == "default-reset"}
        if strategy == "mcmc":
            values |= {"init_opa": 0.5, "init_scale": 0.1, "opacity_reg": 0.01, "scale_reg": 0.01}
        known = {field.name: field for field in dataclasses.fields(cls)}
        for name, value in changes.items():
            if name not in known:
                raise ValueError(f"gsplat-{strategy}: unknown option {name}; known are {', '.join(known)}")
            default = known[name].default
            kind = float if default is None else type(default)
            if kind is float and isinstance(value, (int, str)) and not isinstance(value, bool):
                value = float(value)  # YAML reads 1e-4 as text
            if not isinstance(value, kind):
                raise ValueError(f"gsplat-{strategy}: {name} must be {kind.__name__}, got {value!r}")
            values[name] = value
        return cls(**values)

    def scaled(self, time: int) -> int:
        """Return a time multiplied by `steps_scaler`, rounded down, at least 1."""
        return max(1, int(time * self.steps_scaler))


def load_strategies() -> Any:
    """Import gsplat's strategies; MCMCStrategy calls two functions of gsplat's CUDA extension, here ours."""
    try:
        import gsplat.strategy as strategies
        from gsplat.strategy import ops
    except ImportError as error:
        raise ImportError(
            "the opponents gsplat-* need gsplat's strategies: pip install --no-deps gsplat==1.5.3, or put "
            f"its wheel, which is importable as it is, on PYTHONPATH ({error})"
        ) from error
    ops.compute_relocation = lambda opacities, scales, ratios, binoms: relocate(opacities, scales, ratios, 0)
    ops.quat_scale_to_covar_preci = quat_scale_to_covar_preci
    return strategies


def make_strategy(name: str, options: GsplatOptions) -> Any:
    """Return gsplat's strategy object, its times multiplied by `steps_scaler`."""
    strategies = load_strategies()
    if name == "mcmc":
        strategy = strategies.MCMCStrategy(cap_max=options.cap_max)
        times = ["refine_start_iter", "refine_stop_iter", "refine_every"]
    else:
        strategy = strategies.DefaultStrategy(absgrad=options.absgrad)
        times = ["refine_start_iter", "refine_stop_iter", "refine_every", "reset_every"]
    for time in times:
        setattr(strategy, time, options.scaled(getattr(strategy, time)))
    for field in ("grow_grad2d", "noise_lr"):
        value = getattr(options, field)
        if value is not None:
            if not hasattr(strategy, field):
                raise ValueError(f"gsplat-{name} has no option {field}")
            setattr(strategy, field, value)
    return strategy


def unit_of(capture: Capture) -> float:
    """Return the length that gsplat's trainer makes 1: the median distance of the cameras from their focus.

    The focus is the median, axis by axis, of the point of each camera's optical axis that is nearest to the
    world's origin. (gsplat turns the world upright before, which changes such a median a little.)
    """
    poses = np.stack([camera.world_to_camera for camera in capture.cameras])
    centres = camera_centres(poses) + capture.offset
    axes = poses[:, 2, :3]
    nearest = centres - (axes * centres).sum(axis=1, keepdims=True) * axes
    return float(np.median(np.linalg.norm(centres - np.median(nearest, axis=0), axis=1)))


def space_of(capture: Capture) -> Space:
    """Return gsplat's unit, and as extent its scene scale: 1.1 x the farthest camera from their mean."""
    centres = camera_centres(np.stack([camera.world_to_camera for camera in capture.cameras]))
    farthest = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    unit = unit_of(capture)
    return Space((0.0, 0.0, 0.0), unit, 1.1 * float(farthest) / unit)


class GsplatTrainer:
    """A training with one of gsplat's strategies, batch size 1.

    `params` has the Gaussians before activation: means, scales, quats, opacities, sh0, shN.
    """

    rasterization: Any = staticmethod(rasterization)

    def __init__(
        self,
        strategy: str,
        options: GsplatOptions,
        capture: Capture,
        images: ImageStore,
        device: torch.device,
        seed: int,
    ) -> None:
        """Initialise from the capture's points and put its training photographs on the device.

        `strategy`: one of `STRATEGIES`. `seed`: of the order of views and of every random draw.
        """
        self.options, self.device = options, device
        self.space = space_of(capture)
        self.total, self.step = options.scaled(options.steps), 0
        torch.manual_seed(seed)
        self._strategy, self._is_mcmc = make_strategy(strategy, options), strategy == "mcmc"
        self.params, self._optimisers = self.initialise(capture)
        self.peak = len(self.params["means"])
        self._strategy.check_sanity(self.params, self._optimisers)
        scale = {} if self._is_mcmc else {"scene_scale": self.space.extent}
        self._state = self._strategy.initialize_state(**scale)
        self._decay = torch.optim.lr_scheduler.ExponentialLR(
            self._optimisers["means"], gamma=0.01 ** (1.0 / self.total)
        )
        self.views = ViewSet(capture.cameras, self.space, device)
        self._batches = []
        for index in capture.train:
            mask = images.mask(index)
            mask = None if mask is None else mask[None].to(device)
            self._batches.append((self.views.pick([index]), images.get(index)[None].to(device), mask))
        self._order = self._shuffled(seed)

    def initialise(self, capture: Capture) -> tuple[Any, dict[str, torch.optim.Optimizer]]:
        """Make the parameters and their optimisers."""
        o = self.options
        points = torch.from_numpy(capture.points / self.space.unit).float().to(self.device)
        # Points may coincide; gsplat would give those a size of zero, which has no logarithm.
        spacing = knn_distances(points, 3).square().mean(dim=1).sqrt().clamp(min=1e-7)
        count = len(points)
        colors = torch.from_numpy(capture.colors).to(self.device).float() / 255.0
        values = {
            "means": (points, o.means_lr * self.space.extent),
            "scales": ((spacing * o.init_scale).log()[:, None].repeat(1, 3), o.scales_lr),
            "quats": (torch.rand(count, 4, device=self.device), o.quats_lr),
            "opacities": (torch.full((count,), o.init_opa, device=self.device).logit(), o.opacities_lr),
            "sh0": (((colors - 0.5) / SH_C0)[:, None], o.sh0_lr),
            "shN": (torch.zeros(count, (o.sh_degree + 1) ** 2 - 1, 3, device=self.device), o.shN_lr),
        }
        params = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(value) for name, (value, _) in values.items()}
        )
        optimisers: dict[str, torch.optim.Optimizer] = {
            name: torch.optim.Adam(
                [{"params": params[name], "lr": rate, "name": name}], eps=1e-15, fused=True
            )
            for name, (_, rate) in values.items()
        }
        return params, optimisers

    def _shuffled(self, seed: int) -> Iterator[int]:
        """Yield every training view once, in random order, again and again."""
        generator = torch.Generator().manual_seed(seed)
        while True:
            yield from torch.randperm(len(self._batches), generator=generator).tolist()

    @property
    def sh_degree(self) -> int:
        """The SH degree of the next step."""
        return min(self.step // self.options.scaled(self.options.sh_degree_interval), self.options.sh_degree)

    def train_to(self, step: int) -> None:
        """Train until `step` steps have been taken."""
        while self.step < step:
            self._take_step()
            self.step += 1
            self.peak = max(self.peak, len(self.params["means"]))

    def render(self, views: Any) -> tuple[Tensor, Any]:
        """Return the image of a view and what the strategy needs of it."""
        options, p = self.options, self.params
        image, _, info = self.rasterization(
            p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(),
            torch.cat([p["sh0"], p["shN"]], dim=1), views.viewmats, views.Ks, views.width,
            views.height, near_plane=options.near_plane, far_plane=options.far_plane,
            sh_degree=self.sh_degree, packed=options.packed, absgrad=options.absgrad,
            rasterize_mode="antialiased" if options.antialiased else "classic",
        )  # fmt: skip
        return image, info

    def loss(self, renders: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
        """Return the loss of an image against its photograph."""
        options, params = self.options, self.params
        loss = photometric_loss(renders, target, mask, options.ssim_lambda)[0]
        if options.opacity_reg > 0:
            loss = loss + options.opacity_reg * params["opacities"].sigmoid().mean()
        if options.scale_reg > 0:
            loss = loss + options.scale_reg * params["scales"].exp().mean()
        return loss

    def _take_step(self) -> None:
        views, target, mask = self._batches[next(self._order)]
        image, info = self.render(views)
        self._strategy.step_pre_backward(self.params, self._optimisers, self._state, self.step, info)
        self.loss(image, target, mask).backward()
        for optimiser in self._optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        self._decay.step()
        self.change_population(info)

    def change_population(self, info: Any) -> None:
        """Call the strategy after a step, so that it adds, removes or moves Gaussians."""
        strategy, arguments = self._strategy, (self.params, self._optimisers, self._state, self.step, info)
        if self._is_mcmc:
            strategy.step_post_backward(*arguments, lr=self._decay.get_last_lr()[0])
            return
        strategy.step_post_backward(*arguments, packed=self.options.packed)
        resets = 0 < self.step < strategy.refine_stop_iter and self.step % strategy.reset_every == 0
        if self.options.reset and resets:
            from gsplat.strategy.ops import reset_opa

            reset_opa(self.params, self._optimisers, self._state, value=2.0 * strategy.prune_opa)

    @property
    def render_options(self) -> RenderOptions:
        """The options with which the present model is rendered."""
        return RenderOptions(
            sh_degree=self.options.sh_degree,
            near_plane=self.options.near_plane,
            far_plane=self.options.far_plane,
            antialiased=self.options.antialiased,
        )

    @torch.no_grad()
    def table(self) -> GaussianTable:
        """Return the model as a table, which evaluations take."""
        values = {name: value.detach() for name, value in self.params.items()}
        sh = torch.cat([values.pop("sh0"), values.pop("shN")], dim=1)
        return GaussianTable.create(values | {"sh": sh})
