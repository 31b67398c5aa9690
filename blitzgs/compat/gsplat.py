# SPDX-License-Identifier: Apache-2.0
"""gsplat's strategies of density control, for trainers that have no gsplat installed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from blitzgs.ops.population import MAX_COPIES, position_noise_
from blitzgs.population.density import CHILDREN_OF_A_SPLIT, SPLIT_SHRINK, rotations
from blitzgs.population.relocation import shared_among_copies

Params = MutableMapping[str, Parameter]
Optimizers = Mapping[str, torch.optim.Optimizer]

_REQUIRED = ("means", "quats", "scales", "opacities")
# Share of the population that each refinement of MCMCStrategy adds (Kheradmand et al. 2024).
_GROWTH = 0.05
# The steepness of the noise's sigmoid, as the kernel has it.
_NOISE_STEEPNESS = 100.0


class Strategy:
    """What both strategies share: the check of parameters and optimisers, and calls that do nothing."""

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Check the parameters, [N, ...] each, and their optimisers.

        ValueError: a required parameter or an optimiser is missing, or an optimiser has several groups.
        """
        missing = [name for name in _REQUIRED if name not in params]
        if missing:
            raise ValueError(f"params lack {', '.join(missing)}; they have {', '.join(params)}")
        trained = {name for name, param in params.items() if param.requires_grad}
        if trained != set(optimizers):
            raise ValueError(
                f"optimizers must have the names of the trained params, {sorted(trained)}, got "
                f"{sorted(optimizers)}"
            )
        for name, optimizer in optimizers.items():
            if len(optimizer.param_groups) != 1 or len(optimizer.param_groups[0]["params"]) != 1:
                raise ValueError(f"the optimizer of {name} must have one group of one parameter")

    def step_pre_backward(
        self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """Prepare for `backward()`; call it before."""


@dataclass
class DefaultStrategy(Strategy):
    """Density control of 3DGS (Kerbl et al. 2023, section 5): clone, split, prune, reset opacities.

    Attributes:
        prune_opa: Gaussians of lower opacity are pruned.
        grow_grad2d: mean gradient of the projected mean, in half images, above which a Gaussian grows.
        grow_scale3d: Gaussians up to this size are cloned, larger ones split; in units of `scene_scale`.
        grow_scale2d: Gaussians of a larger radius are split; in units of the longer side of the image.
        prune_scale3d, prune_scale2d: after the first reset, larger Gaussians are pruned, in the same units.
        refine_scale2d_stop_iter: step from which radii do not count; 0: they never do.
        refine_start_iter, refine_stop_iter: refinement begins after the first step and ends at the second.
        reset_every: steps between two resets of the opacities to at most twice `prune_opa`, as in gsplat's
            main branch; a slip in the condition of 1.5.3 leaves them out.
        refine_every: steps between two refinements.
        pause_refine_after_reset: steps without refinement after each reset.
        absgrad: whether `info["means2d"].absgrad` counts (`rasterization(..., absgrad=True)`).
        revised_opacity: whether the children of a split together are as opaque as their parent.
        verbose: whether each refinement prints what it did.
        key_for_gradient: the entry of `info` whose gradient counts.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    absgrad: bool = False
    revised_opacity: bool = False
    verbose: bool = False
    key_for_gradient: str = "means2d"

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return the state; its tensors, [N] each, are made at the first step."""
        state: dict[str, Any] = {"grad2d": None, "count": None, "scene_scale": scene_scale}
        return {**state, "radii": None} if self.refine_scale2d_stop_iter > 0 else state

    def step_pre_backward(
        self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """Keep the gradient of the projected means; call it before `backward()`."""
        info[self.key_for_gradient].retain_grad()

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
        scene: Any = None,
    ) -> None:
        """Add the step's statistics, and refine or reset where it is time; call it after `backward()`.

        A `blitzgs.optim.LazyAdam` is caught up where it has to be.

        Args:
            params: changed in place: their entries are replaced.
            optimizers: one for each parameter; any whose state has a row for each row of its parameter.
            state: from `initialize_state`.
            step: number of the step.
            info: what the renderer returned.
            packed: accepted; `info` tells it.
            scene: told of the changes (`on_duplicate`, `on_split`, `on_remove`), as gsplat's main branch has
                it.
        """
        if step >= self.refine_stop_iter:
            return
        self._add_statistics(params, state, info)
        due = step > self.refine_start_iter and step % self.refine_every == 0
        if due and step % self.reset_every >= self.pause_refine_after_reset:
            _catch_up(optimizers, moments=True)
            self._refine(params, optimizers, state, step, scene)
        if step % self.reset_every == 0 and step > 0:
            _catch_up(optimizers, moments=True)
            most = math.log(2 * self.prune_opa / (1 - 2 * self.prune_opa))
            _renew(params, optimizers, lambda _, p: p.clamp(max=most), torch.zeros_like, ["opacities"])

    def _add_statistics(self, params: Params, state: dict[str, Any], info: dict[str, Any]) -> None:
        means2d = info[self.key_for_gradient]
        name = "absgrad" if self.absgrad else "grad"
        if (gradients := getattr(means2d, name, None)) is None:
            remedy = (
                "render with absgrad=True" if self.absgrad else "call step_pre_backward before backward()"
            )
            raise ValueError(f'info["{self.key_for_gradient}"] has no {name}; {remedy}')
        width, height, views = info["width"], info["height"], info["n_cameras"]
        across, down = gradients.unbind(-1)
        norms = torch.hypot(across * (width / 2 * views), down * (height / 2 * views))
        ids, radii = info["gaussian_ids"], info["radii"]
        longest = radii.amax(dim=-1).to(norms.dtype) / max(width, height)
        for name in ("grad2d", "count", "radii"):
            if name in state and state[name] is None:
                state[name] = norms.new_zeros(len(params["means"]))
        if ids is None:  # sums over the views: for a list of what they see, the host would wait
            unseen = (radii <= 0).any(dim=-1).flatten(0, -2)
            norms, longest = (t.flatten(0, -2).masked_fill(unseen, 0) for t in (norms, longest))
            state["grad2d"] += norms.sum(dim=0)
            state["count"] += len(unseen) - unseen.sum(dim=0)
            if "radii" in state:
                state["radii"] = state["radii"].maximum(longest.amax(dim=0))
            return
        state["grad2d"].index_add_(0, ids, norms)
        state["count"].index_add_(0, ids, torch.ones_like(norms, dtype=state["count"].dtype))
        if "radii" in state:
            state["radii"].scatter_reduce_(0, ids.long(), longest, "amax")

    def _refine(
        self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int, scene: Any
    ) -> None:
        """Clone and split, and prune old and new rows, in one pass over the parameters."""
        high = state["grad2d"] / state["count"].clamp(min=1) > self.grow_grad2d
        sizes = params["scales"].amax(dim=-1).exp()
        small = sizes <= self.grow_scale3d * state["scene_scale"]
        splits = high & ~small
        by_radius = step < self.refine_scale2d_stop_iter
        if by_radius:
            splits |= state["radii"] > self.grow_scale2d
        cloned, split = (high & small).nonzero()[:, 0], splits.nonzero()[:, 0]
        # A Gaussian that is both, by its radius, is split, and its clone stays.
        kept = torch.cat([(~splits).nonzero()[:, 0], cloned])
        rows = torch.cat([kept, *[split] * CHILDREN_OF_A_SPLIT])
        children = self._children(params, split)
        grown = {
            name: torch.cat([params[name][kept], children[name]]) if name in children else params[name][rows]
            for name in params
        }
        pruned = grown["opacities"].flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            pruned |= grown["scales"].amax(dim=-1).exp() > self.prune_scale3d * state["scene_scale"]
            if by_radius:
                pruned |= state["radii"][rows] > self.prune_scale2d
        old = torch.arange(len(rows), device=rows.device) < len(kept) - len(cloned)
        lives = (~pruned).nonzero()[:, 0]
        _renew(
            params, optimizers, lambda name, _: grown[name][lives],
            lambda moment: (moment[rows] * old.view(-1, *[1] * (moment.dim() - 1)))[lives],
        )  # fmt: skip
        for name in ("grad2d", "count", "radii"):
            if name in state:
                state[name] = state[name].new_zeros(len(lives))
        if scene is not None:
            count = len(splits)
            beyond = torch.arange(count, count + len(cloned), device=split.device)
            scene.on_duplicate(cloned)
            scene.on_split(split, torch.cat([(~splits).nonzero()[:, 0], beyond]))
            scene.on_remove(pruned)
        if self.verbose:
            counts = f"{len(cloned)} cloned, {len(split)} split, {len(rows) - len(lives)} pruned"
            print(f"Step {step}: {counts}, now {len(lives)} Gaussians")

    def _children(self, params: Params, split: Tensor) -> dict[str, Tensor]:
        """Return what differs from the parents: the first children of the rows `split`, then the second."""
        scales = params["scales"][split].exp()
        draws = torch.randn(CHILDREN_OF_A_SPLIT, *scales.shape, dtype=scales.dtype, device=scales.device)
        axes = rotations(params["quats"][split])
        offsets = (axes * (draws * scales)[:, :, None]).sum(dim=-1)
        children = {
            "means": (params["means"][split] + offsets).flatten(0, 1),
            "scales": (scales / SPLIT_SHRINK).log().repeat(CHILDREN_OF_A_SPLIT, 1),
        }
        if self.revised_opacity:  # Rota Bulo et al. 2024, "Revising Densification in Gaussian Splatting"
            each = 1 - (1 - params["opacities"][split].sigmoid()).sqrt()
            children["opacities"] = torch.cat([each.logit()] * CHILDREN_OF_A_SPLIT)
        return children


@dataclass
class MCMCStrategy(Strategy):
    """3DGS-MCMC (Kheradmand et al. 2024): dead Gaussians move to live ones, and positions get noise.

    Attributes:
        cap_max: number of Gaussians at which the population stops growing; relocation goes on.
        noise_lr: the noise's strength is this times the learning rate of the means.
        refine_start_iter, refine_stop_iter: refinement begins after the first step and ends at the second.
        noise_injection_stop_iter: step from which there is no noise; -1: there always is.
        refine_every: steps between two refinements, each of which adds 5 %.
        min_opacity: Gaussians up to this opacity are dead.
        verbose: whether each refinement prints what it did.
        noise_opacity_t: opacity at which the noise falls to a half.
        noise_opacity_k: steepness of this fall.

    ValueError: `refine_every` is no number of steps.
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    noise_injection_stop_iter: int = -1
    refine_every: int = 100
    min_opacity: float = 0.005
    verbose: bool = False
    noise_opacity_t: float = 0.005
    noise_opacity_k: float = _NOISE_STEEPNESS

    def __post_init__(self) -> None:
        if self.refine_every != int(self.refine_every) or self.refine_every < 1:
            raise ValueError(
                f"refine_every must be a whole number of steps, got {self.refine_every}; the order of the "
                "arguments is that of gsplat's main branch, so pass them by name"
            )

    def initialize_state(self) -> dict[str, Any]:
        """Return the state, which is empty."""
        return {}

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        lr: float,
        scene: Any = None,
    ) -> None:
        """Refine where it is time, and add noise; call it after `backward()`.

        A `blitzgs.optim.LazyAdam` is caught up. The noise's draws depend on `torch.initial_seed()`, `step`
        and the row.

        Args:
            params: changed in place: means move, and a refinement replaces the entries.
            optimizers, state, step: as in `DefaultStrategy`; `info` is not read.
            lr: learning rate of the means.
            scene: told of the changes (`on_relocate`, `on_sample_add`), as gsplat's main branch has it.
        """
        if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
            _catch_up(optimizers, moments=True)
            self._refine(params, optimizers, step, scene)
        if 0 <= self.noise_injection_stop_iter <= step:
            return
        _catch_up(optimizers)
        means, quats, scales, opacities = (params[name].detach() for name in _REQUIRED)
        ids = torch.arange(len(means), device=means.device)
        logits, threshold = opacities.view(-1), self.noise_opacity_t
        if self.noise_opacity_k != _NOISE_STEEPNESS:
            # The kernel's steepness is fixed: opacities are stretched about its threshold instead.
            stretch = self.noise_opacity_k / _NOISE_STEEPNESS
            logits, threshold = torch.logit(0.5 + stretch * (logits.sigmoid() - threshold), eps=1e-7), 0.5
        position_noise_(
            means, quats, scales, logits, ids, ids.int(), seed=torch.initial_seed() & (2**31 - 1),
            step=step, threshold=threshold, strength=lr * self.noise_lr,
        )  # fmt: skip

    def _refine(self, params: Params, optimizers: Optimizers, step: int, scene: Any) -> None:
        count = len(params["means"])
        opacities = params["opacities"].flatten().sigmoid()
        dead = (opacities <= self.min_opacity).nonzero()[:, 0]
        live = opacities.masked_fill(opacities <= self.min_opacity, 0)
        if len(dead) and len(dead) < count:
            sources = _sample(live, len(dead))
            changed = self._shares(params, sources)
            moved = torch.arange(count, device=dead.device).index_copy_(0, dead, sources)
            _renew(
                params, optimizers, lambda name, p: changed.get(name, p)[moved],
                lambda moment: moment.index_fill(0, sources, 0),
            )  # fmt: skip
            if scene is not None:
                scene.on_relocate(dead, sources)
        added = min(self.cap_max, int((1 + _GROWTH) * count)) - count
        if added > 0:
            sources = _sample(params["opacities"].flatten().sigmoid(), added)
            changed = self._shares(params, sources)
            _renew(
                params, optimizers,
                lambda name, p: torch.cat([changed.get(name, p), changed.get(name, p)[sources]]),
                lambda moment: torch.cat([moment, moment.new_zeros(added, *moment.shape[1:])]),
            )  # fmt: skip
            if scene is not None:
                scene.on_sample_add(sources)
        if self.verbose:
            now = f"now {len(params['means'])} Gaussians"
            print(f"Step {step}: {len(dead)} relocated, {max(0, added)} added, {now}")

    def _shares(self, params: Params, sources: Tensor) -> dict[str, Tensor]:
        """Return the opacities and scales when each Gaussian is copied as often as it is in `sources`."""
        times = torch.bincount(sources, minlength=len(params["means"]))
        rows = times.nonzero()[:, 0]
        opacities, scales = params["opacities"].detach(), params["scales"].detach()
        logits, logs = shared_among_copies(
            opacities.flatten()[rows], scales[rows], (times[rows] + 1).clamp(max=MAX_COPIES)
        )
        logits = logits.clamp(min=math.log(self.min_opacity / (1 - self.min_opacity)))
        return {
            "opacities": opacities.index_copy(0, rows, logits.to(opacities).view(-1, *opacities.shape[1:])),
            "scales": scales.index_copy(0, rows, logs.to(scales)),
        }


def _catch_up(optimizers: Optimizers, **options: bool) -> None:
    """Apply the steps that are pending in optimisers that postpone some (`blitzgs.optim.LazyAdam`)."""
    for optimizer in optimizers.values():
        if hasattr(optimizer, "catch_up"):
            optimizer.catch_up(**options)


def _sample(weights: Tensor, count: int) -> Tensor:
    """Draw rows in proportion to weights [N] with replacement, int64 [count], for any N."""
    total = weights.double().cumsum(0)
    draws = torch.rand(count, dtype=torch.float64, device=weights.device) * total[-1]
    return torch.searchsorted(total, draws, right=True).clamp(max=len(weights) - 1)


def _renew(
    params: Params,
    optimizers: Optimizers,
    of_param: Callable[[str, Tensor], Tensor],
    of_moment: Callable[[Tensor], Tensor],
    names: list[str] | None = None,
) -> None:
    """Replace parameters, and the rows of their optimisers' states, by what the functions make of them.

    No step may be pending.
    """
    for name in list(params) if names is None else names:
        old = params[name]
        new = params[name] = Parameter(of_param(name, old.detach()), requires_grad=old.requires_grad)
        if name not in optimizers:
            continue
        optimizer = optimizers[name]
        optimizer.param_groups[0]["params"] = [new]
        saved = optimizer.state.pop(old, {})
        if saved:
            optimizer.state[new] = {
                key: of_moment(value) if isinstance(value, Tensor) and value.shape == old.shape else value
                for key, value in saved.items()
            }
