# SPDX-License-Identifier: Apache-2.0
"""The configuration of a run: nested dataclasses, one per concern, with the defaults of the method.

Times are counted in images and are multiplied by `schedule.scale`; lengths are relative to the scene's
`extent` (1.1 x the largest distance of a camera from their mean centre), never absolute.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class DataConfig:
    """Where images come from and which are held out.

    Attributes:
        path: folder of the capture.
        images: image folder inside the capture.
        downscale: integer factor by which images are reduced (1: as they are).
        masks: mask folder inside the capture; null uses `masks/` where there is one, true requires it, false
            uses none.
        split: which views are held out: a number n (every n-th), "val" (Mega-NeRF's `val/` layout), a text
            file with one image name a line, or "auto": `val/` where there is one, else every 8th.
        undistort: where a distorted image does not fill its pinhole image: "crop" or "mask".
        exif: "auto" turns an image by its EXIF tag where only that fits its camera; or "apply", "ignore".
        allow_missing: drop views whose image is missing instead of failing.
        cache_bytes: budget for the compressed images held in memory, of all ranks of a host together; decoded
            ones take a quarter of it beside.
        threads: decoder threads.
        prefetch: batches decoded and uploaded ahead.
    """

    path: str = ""
    images: str = "images"
    downscale: int = 1
    masks: str | bool | None = None
    split: str = "auto"
    undistort: str = "crop"
    exif: str = "auto"
    allow_missing: bool = False
    cache_bytes: int = 8_000_000_000
    threads: int = 4
    prefetch: int = 3


@dataclass(frozen=True)
class ModelConfig:
    """What is rendered.

    Attributes:
        sh_degree: highest spherical-harmonics degree, 0..3.
        background: colour behind everything, RGB in [0, 1].
        antialiased: compensate the screen-space blur (Mip-Splatting's 2D filter) instead of the classic
            image.
        near: near plane, relative to extent.
        far: far plane, relative to extent.
        eps2d: screen-space blur added to the projected covariance, pixels squared.
        deterministic: repeat a run bit for bit on CUDA too (the CPU always does), at some cost.
        initial_opacity: opacity of the initial Gaussians.
        scale_floor: smallest standard deviation of a Gaussian, in pixels of the training view that samples it
            most finely, which is found anew at every tenth density event; 0: none. Mip-Splatting's 3D filter
            has 0.447.
    """

    sh_degree: int = 3
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = False
    near: float = 0.01
    far: float = 1e6
    eps2d: float = 0.3
    deterministic: bool = False
    initial_opacity: float = 0.1
    scale_floor: float = 0.0


@dataclass(frozen=True)
class LodConfig:
    """The octree of the initial Gaussians: multi-resolution voxels of the SfM cloud.

    Attributes:
        fork: ratio f of the voxel sizes of neighbouring levels.
        visible_threshold: a voxel is kept when its level is resolvable in more than this share of the
            cameras.
        base_resolution: finest sensible voxel relative to the scene's box; sets the coarsest level's size.
    """

    fork: float = 2.0
    visible_threshold: float = 0.9
    base_resolution: float = 0.001


@dataclass(frozen=True)
class ScheduleConfig:
    """When things happen, in images; `scale` multiplies every time below.

    Attributes:
        iterations: length of the run.
        scale: stretches or compresses the whole schedule without changing its shape.
        minutes: fits the schedule into so much wall time of training (`blitzgs train --minutes`): the run
            measures how fast it is and changes its pace accordingly; `scale` stays 1. 0: no such limit.
        pace: pairs (image of the run, factor): from that image on, `scale` counts times the factor. A run
            with `minutes` notes its changes of pace here; without `minutes` they are followed as they are.
        adaptive: places `t1`, `densify_until` and `t2`, in this order, where the run's own growth and loss
            say, at most `adaptive_limit` of each earlier or later (`blitzgs/training/adaptive.py`).
        adaptive_limit: that share.
        placed: the places found so far, up to three times. A run with `adaptive` notes them here; without it
            they are followed as they are.
        batch_size: views per optimiser step B; one step advances the clock by B.
        densify_from, densify_until, densify_every: density-control events at from, from + every, ... < until.
        size_prune_after: density events later than this also prune by size.
        reset_every: all opacities are capped at `population.reset_opacity` at every multiple of this before
            `densify_until`; 0: never.
        gate_from: density events from here on go through `population.gate`.
        t1, t2: the first and the second importance pass, where `population.importance` is set; 0: none. A
            pass follows the density event of the same image.
        levels_until: from here on `view.lod` may keep all octree levels; it begins with those that
            `view.first_levels` says. 0: `densify_until`.
        sh_every: the spherical-harmonics degree grows by one each time.
        position_decay: length of the exponential decay of the position learning rate.
        checkpoint_every: checkpoints at these times, besides those of `log.checkpoint_seconds`. 0: none.
        evaluate_every: 0 evaluates at the end only.
    """

    iterations: int = 30_000
    scale: float = 1.0
    minutes: float = 0.0
    pace: tuple[tuple[int, float], ...] = ()
    adaptive: bool = False
    adaptive_limit: float = 0.4
    placed: tuple[int, ...] = ()
    batch_size: int = 1
    densify_from: int = 500
    densify_until: int = 15_000
    densify_every: int = 100
    size_prune_after: int = 3_000
    reset_every: int = 0
    gate_from: int = 11_250
    t1: int = 7_500
    t2: int = 16_000
    levels_until: int = 0
    sh_every: int = 1_000
    position_decay: int = 30_000
    checkpoint_every: int = 0
    evaluate_every: int = 0


@dataclass(frozen=True)
class OptimiserConfig:
    """Adam with batch scaling: lr sqrt(B), beta^B, eps / sqrt(B).

    Attributes:
        position, position_final: learning rates of the means, relative to extent, at the start and after
            `schedule.position_decay`.
        sh_dc, sh_rest, opacity, scale, rotation: learning rates.
        position_noise: random steps of almost transparent Gaussians along their own axes, relative to the
            position rate (3DGS-MCMC's noise, whose lengths are relative to extent here); 0: none.
        final_share: the share of these five rates that is left at the end of the run, reached exponentially;
            1 keeps them constant.
        beta1, beta2, eps: Adam's constants for B = 1.
        sparse: leave the rows outside a step's active set alone (no decay, no drift) instead of repaying the
            steps they missed.
    """

    position: float = 1.6e-4
    position_final: float = 1.6e-6
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    opacity: float = 2.5e-2
    scale: float = 5e-3
    rotation: float = 1e-3
    position_noise: float = 0.0
    final_share: float = 1.0
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    sparse: bool = False


@dataclass(frozen=True)
class LossConfig:
    """(1 - ssim) L1 + ssim (1 - SSIM) + scale L_scale + opacity L_opacity per view.

    Attributes:
        ssim: weight of the SSIM term.
        opacity: weight of the mean opacity of the visible Gaussians (3DGS-MCMC has that of all Gaussians;
            those that a step does not see are left alone here).
        scale: weight of the mean smallest axis of the visible Gaussians.
        scale_reference: that axis is measured in units of extent x scale_reference.
    """

    ssim: float = 0.2
    opacity: float = 0.0
    scale: float = 10.0
    scale_reference: float = 10.0


@dataclass(frozen=True)
class PopulationConfig:
    """Density control: which Gaussians are cloned, split and pruned, and the two importance passes.

    Attributes:
        strategy: what a density event does: "density" (clone and split by gradients, prune) or "relocation"
            (3DGS-MCMC: Gaussians that would be pruned become copies of others, drawn by opacity, and the
            population grows by `growth`).
        relocate: with "density", Gaussians that would be pruned become copies of others, too.
        growth: share of the population that "relocation" adds at each event.
        grad_threshold: mean norm of the 2D-mean gradient (half-image units) above which a Gaussian is
            densified.
        absolute_gradients: take the sum over pixels of the absolute gradients in its place (AbsGS), in which
            those of a Gaussian's two halves do not cancel.
        absolute_threshold: in the place of `grad_threshold` with `absolute_gradients`.
        clone_scale: Gaussians up to this largest axis (relative to extent) are cloned, larger ones split.
        min_opacity: Gaussians below are pruned.
        reset_opacity: what `schedule.reset_every` caps the opacities at.
        opacity_decay: share of its opacity that every Gaussian loses at each density event.
        prune_screen_radius: pixels; larger Gaussians are pruned after `schedule.size_prune_after`.
        prune_world_scale: relative to extent; Gaussians with a larger axis are pruned after the same time.
        max_gaussians: the population never exceeds this; the strongest candidates come first. 0: no cap.
        importance: at `schedule.t1` and `schedule.t2` score all Gaussians by what they contribute to the
            training views, and keep those that matter.
        score: what the passes score by, summed over the views: "density" (the paper's: contribution per
            pixel), "weight" (contribution) or "root" (contribution over the root of the pixels).
        pass1_keep: share of the Gaussians that the first pass keeps, drawn by their scores; 1: all, the pass
            then makes its signals alone.
        pass2_mass: share of the total score that the second pass keeps, by the fewest Gaussians, of which
            those below `min_opacity` go too; 1: all, as above.
        pass2_keep: share of the Gaussians that the second pass keeps at most, those of the highest scores;
            1: as many as `pass2_mass` says.
        phi: from the first pass on, weigh the gradients that density control adds up with phi, the share of
            the views seeing a Gaussian in which it counts.
        gate: model file of a spawn gate (`blitzgs gate fit`), or "default" for the one that comes with
            BlitzGS and suits configs/compact.yaml; null: none.
        gate_rate: share of the candidates, clones and splits apart, that the gate withholds at each density
            event from `schedule.gate_from` on.
        lineage: log every birth and death as Parquet files in the run's folder `lineage` (needs pyarrow).
        pixels_per_gaussian: nor does it exceed the pixels of all training photographs over this. 0: no cap.
        gaussians_per_point: nor the points of the reconstruction times this, whose number follows the detail
            that photographs share. 0: no cap.
        min_observations: a Gaussian is densified by the mean of at least so many gradients, one for each view
            of a step that sees it; they are gathered over as many density events as that takes.
    """

    strategy: str = "density"
    relocate: bool = False
    growth: float = 0.05
    grad_threshold: float = 2e-4
    absolute_gradients: bool = False
    absolute_threshold: float = 8e-4
    clone_scale: float = 0.01
    min_opacity: float = 0.005
    reset_opacity: float = 0.01
    opacity_decay: float = 0.0
    prune_screen_radius: float = 20.0
    prune_world_scale: float = 0.1
    max_gaussians: int = 0
    importance: bool = False
    score: str = "density"
    pass1_keep: float = 0.7
    pass2_mass: float = 0.99
    pass2_keep: float = 1.0
    phi: bool = True
    gate: str | None = None
    gate_rate: float = 0.6
    lineage: bool = False
    pixels_per_gaussian: float = 24.0
    gaussians_per_point: float = 0.0
    min_observations: int = 1


@dataclass(frozen=True)
class ViewConfig:
    """What a view leaves out before it is projected.

    Attributes:
        lod: from `schedule.densify_until` on, views leave out Gaussians whose octree level is too fine for
            their distance. The trained model is evaluated and rendered so, too.
        first_levels: the finest level that this may keep at the start of the run, relative to their number.
        level_ratio: the others come one by one until `schedule.levels_until`, each after a wait shorter by
            this factor than the one before.
        most_kept: views that would keep at least this share of all Gaussians are rendered with all of them.
        smooth: opacities fade out over half a level around the distance at which `lod` would cut them off.
            All views then have the gate, whatever `most_kept` says. Needs `lod`.
        cull: from the first importance pass on, a training view leaves out the Gaussians that did not count
            in it at the last pass, until half of the images after the last pass are trained on. Needs
            `population.importance`.
    """

    lod: bool = False
    first_levels: float = 0.5
    level_ratio: float = 1.5
    most_kept: float = 0.8
    smooth: bool = False
    cull: bool = False


@dataclass(frozen=True)
class MemoryConfig:
    """Where the Gaussians are while they train; nothing here changes the result beyond rounding.

    Attributes:
        resident_gb: gigabytes of each rank's device for Gaussians. The others wait in the memory of the host
            and come when the views of a step are about to need them. 0: all are on the device.
    """

    resident_gb: float = 0.0


@dataclass(frozen=True)
class RanksConfig:
    """How several processes share a run; nothing here changes its result beyond rounding.

    Attributes:
        timeout_seconds: a rank that does not show up at a collective for this long ends the job.
        transport: how Gaussians travel: "peer" (written to the other GPUs' memory), "collective" (NCCL or
            Gloo) or "auto" (the former where it works).
        share_gpus: where a host has fewer GPUs than ranks, let ranks share them, for development: a step
            then waits for each rank's turn on the GPU.
        half_exchange: exchange projected Gaussians in half precision (for slow links, less exact; always
            collective).
        max_imbalance: Gaussians move between ranks when the largest shard exceeds the smallest by this
            factor.
    """

    timeout_seconds: float = 120.0
    transport: str = "auto"
    share_gpus: bool = False
    half_exchange: bool = False
    max_imbalance: float = 1.1


@dataclass(frozen=True)
class LogConfig:
    """What a run reports.

    Attributes:
        every: images between two log records.
        tensorboard: also write TensorBoard events (when the package is installed).
        pictures: side-by-side pictures written by an evaluation.
        checkpoint_seconds: a checkpoint is written this long after the last one, so that whatever ends a run
            costs no more than this. 0: never by the clock.
        keep_checkpoints: how many checkpoints stay on disk.
        lpips_weights: path of LPIPS weights for the evaluation, or null.
    """

    every: int = 100
    tensorboard: bool = True
    pictures: int = 8
    checkpoint_seconds: float = 600.0
    keep_checkpoints: int = 3
    lpips_weights: str | None = None


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run computes.

    Attributes:
        seed: of the batch order and of every random draw.
    """

    data: DataConfig = field(default_factory=DataConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    lod: LodConfig = field(default_factory=LodConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    population: PopulationConfig = field(default_factory=PopulationConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
    memory: MemoryConfig = field(default_factory=MemoryConfig)
    ranks: RanksConfig = field(default_factory=RanksConfig)
    log: LogConfig = field(default_factory=LogConfig)
    seed: int = 0
