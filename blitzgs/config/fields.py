# SPDX-License-Identifier: Apache-2.0
"""The configuration of a run: one dataclass per section, with its fields' meaning, defaults and ranges.

Times are counted in images and are multiplied by `schedule.scale`. Lengths are relative to the scene's
`extent` (1.1 x the largest distance of a training camera from the mean camera centre), never absolute.

The ranges exclude values that cannot work (an infinite rate, an opacity of 2) or that would exhaust memory or
never end; they are far from any sensible value.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal


@dataclass(frozen=True)
class Range:
    """The numbers from `low` to `high`; an end that is open is excluded."""

    low: float
    high: float
    low_open: bool = False
    high_open: bool = False

    def __contains__(self, value: float) -> bool:
        above = value > self.low if self.low_open else value >= self.low
        return above and (value < self.high if self.high_open else value <= self.high)

    def __str__(self) -> str:
        brackets = "(" if self.low_open else "[", ")" if self.high_open else "]"
        return f"in {brackets[0]}{self.low:,.12g}, {self.high:,.12g}{brackets[1]}"


SCALE = Range(1e-4, 1e4)
# Ranges of several fields.
Share = Annotated[float, Range(0, 1)]
Kept = Annotated[float, Range(0, 1, low_open=True)]
Rate = Annotated[float, Range(0, 10)]
Amount = Annotated[float, Range(0, 1e6)]
Time = Annotated[int, Range(0, 1e9)]
Interval = Annotated[int, Range(1, 1e9)]

# How splats travel between ranks, and how an importance pass scores Gaussians.
Transport = Literal["auto", "peer", "collective"]
ScoreRule = Literal["density", "root", "weight", "energy"]


@dataclass(frozen=True)
class DataConfig:
    """Which capture is trained on, how its images are read, and which views are held out.

    Attributes:
        path: folder of the capture.
        images: image folder inside the capture.
        downscale: integer factor by which images are reduced (1: original size).
        masks: mask folder inside the capture; null uses `masks/` where there is one, true requires it, false
            uses none.
        split: which views are held out: a number n (every n-th; 0: none), "val" (Mega-NeRF's `val/` layout),
            a text file with one image name a line, or "auto": the capture's own split if it has one, else
            every 8th.
        undistort: what happens to the part of a pinhole image that the distorted image does not cover: "crop"
            cuts it off, "mask" masks it.
        exif: "auto" turns an image by its EXIF tag if only the turned image fits its camera; "apply" always
            turns it, "ignore" never.
        allow_missing: drop views whose image is missing or damaged instead of failing.
        inside_only: refuse captures with names that lead outside their folder.
        sparse: which of several COLMAP models (sparse/0, sparse/1, ...) is read: the "largest", "all" of
            them, which must have the same world coordinates, or a folder inside the capture.
        stray_cameras: "drop" leaves out cameras that lie far apart from all others and hardly show a point,
            "keep" trains on them. The scene's lengths are measured without them either way.
        cache_bytes: memory for compressed images, of all ranks of a host together, at most half of the host's
            memory; decoded images take what these leave, and up to a quarter of it in addition. If all
            decoded images fit into half of it, the ranks of a host share them.
    """

    path: str = ""
    images: str = "images"
    downscale: Annotated[int, Range(1, 1000)] = 1
    masks: str | bool | None = None
    split: str = "auto"
    undistort: Literal["crop", "mask"] = "crop"
    exif: Literal["auto", "apply", "ignore"] = "auto"
    allow_missing: bool = False
    inside_only: bool = False
    sparse: str = "largest"
    stray_cameras: Literal["drop", "keep"] = "drop"
    cache_bytes: Annotated[int, Range(0, 2**50)] = 8_000_000_000


@dataclass(frozen=True)
class ModelConfig:
    """How Gaussians are rendered, and how they begin.

    Attributes:
        sh_degree: highest spherical-harmonics degree, 0..3.
        background: colour behind everything, RGB in [0, 1], also behind transparent photographs. null: black,
            or with `random_background` the mean colour of photographs without alpha; the run's own
            configuration has the result.
        random_background: each training view has a random colour behind everything instead, so that
            Gaussians have to cover all that photographs show; otherwise places of the background's colour
            stay transparent. No effect if photographs are transparent.
        antialiased: scale opacities to compensate the screen-space blur (Mip-Splatting's 2D filter); false:
            classic 3DGS.
        near: near plane, relative to extent. 0: a quarter of the depth of the nearest points that training
            views see, 0.01 at most; the run's own configuration has the result.
        deterministic: make a run repeat bit for bit on CUDA too, at some cost in time (the CPU always does).
        exposure: if photographs differ in exposure, each training photograph has a gain and a bias of its
            channels: gains are estimated from the points' tracks, where there are tracks, and both are
            refined in training. Views are rendered with the mean exposure (`blitzgs render --exposure`:
            with the photograph's), so held-out photographs are farther from them: `psnr_corrected` compares
            without exposure.
        start: file of Gaussians of any program to begin with (`--start`), in the capture's
            coordinates; empty: Gaussians on the capture's points.
    """

    sh_degree: Annotated[int, Range(0, 3)] = 3
    background: Annotated[tuple[float, float, float] | None, Range(0, 1)] = None
    random_background: bool = False
    antialiased: bool = False
    near: Amount = 0.0
    deterministic: bool = False
    exposure: bool = False
    start: str = ""


@dataclass(frozen=True)
class LodConfig:
    """The octree of the initial Gaussians: multi-resolution voxels of the SfM cloud.

    Attributes:
        visible_threshold: a voxel is kept when its level is resolvable in more than this share of the
            cameras.
    """

    visible_threshold: Annotated[float, Range(0, 1, high_open=True)] = 0.9


# The background that `ModelConfig.background` stands for where nothing else is said.
BLACK = (0.0, 0.0, 0.0)

# Ratio f of the voxel sizes of neighbouring octree levels.
FORK = 2.0

# The largest factor by which `schedule.images_per_view` makes a run longer.
MAX_STRETCH = 10.0

# The share of the position rate that is left in the end, and that of the rate of `sh_dc` for other SH.
POSITION_LEFT, SH_SHARE = 0.01, 0.05

# The opacities that `schedule.reset_every` leaves are at most this.
RESET_OPACITY = 0.01


@dataclass(frozen=True)
class ScheduleConfig:
    """The times of all events, counted in images; `scale` multiplies every time below.

    Attributes:
        iterations: length of the run.
        scale: stretches or compresses the whole schedule without changing its shape.
        images_per_view: how often a new run sees each training view on average, at least: it multiplies
            `scale` by the factor that is needed for this, from 1 to 10. The run's own
            configuration has the product in `scale`, and 0 here. With 0 or with `minutes` the length does not
            depend on the number of views.
        minutes: wall time of training that the schedule is fitted into (`--minutes`): the run
            measures its speed and changes its pace; `scale` stays 1. 0: no limit.
        pace: pairs (image of the run, factor): from that image on, `scale` is multiplied by the factor. A run
            with `minutes` writes its changes of pace here; a run without `minutes` repeats them.
        batch_size: B, views per optimiser step; a step advances the clock by B images.
        resolution: pairs (factor, time): up to that time, training compares with photographs whose width and
            height are divided by the factor, 8, 4 or 2. [[4, 1000], [2, 4000]]: a quarter, then half, then
            all. Everything else has the full resolution: importance passes, the cull mask, evaluation.
        densify_from, densify_until, densify_every: density events happen at from, from + every, ... < until.
        size_prune_after: density events later than this also prune by size.
        reset_every: all opacities are capped at `RESET_OPACITY` (0.01) at every multiple of this before
            `densify_until`; 0: never.
        gate_from: from here on `population.gate` judges the candidates of density events; no effect without a
            gate.
        t1, t2: times of the first and the second importance pass, if `population.importance` is set; 0: no
            pass. A pass happens after the density event of the same time.
        sh_every: the spherical-harmonics degree grows by one at every multiple of this.
        position_decay: length of the exponential decay of the position learning rate.
        checkpoint_every: a checkpoint is written at every multiple of this, in addition to those by
            `log.checkpoint_seconds`. 0: none.
        evaluate_every: the held-out views are measured at every multiple of this, and at the end. 0: all of
            them only at the end, and a few now and then, in less than 1 % of the time.
    """

    iterations: Interval = 30_000
    scale: Annotated[float, SCALE] = 1.0
    images_per_view: Amount = 0.0
    minutes: Amount = 0.0
    pace: Annotated[tuple[tuple[int, float], ...], Range(1e-4, 1e9)] = ()
    batch_size: Annotated[int, Range(1, 32)] = 1
    resolution: Annotated[tuple[tuple[int, int], ...], Range(1, 1e9)] = ()
    densify_from: Time = 500
    densify_until: Time = 15_000
    densify_every: Interval = 100
    size_prune_after: Time = 3_000
    reset_every: Time = 0
    gate_from: Time = 11_250
    t1: Time = 7_500
    t2: Time = 16_000
    sh_every: Interval = 1_000
    position_decay: Interval = 30_000
    checkpoint_every: Time = 0
    evaluate_every: Time = 0


@dataclass(frozen=True)
class OptimiserConfig:
    """Adam with batch scaling: lr sqrt(B), beta^B, eps / sqrt(B).

    Attributes:
        position: learning rate of the means at the start, relative to extent; after
            `schedule.position_decay` a hundredth of it is left.
        sh_dc: learning rate of the colours' constant part; that of the other SH coefficients is a twentieth.
        opacity, scale, rotation: learning rates.
        final: share of the rates of colour, scale and rotation that is left in the end; they fall from
            `schedule.densify_until` until `schedule.position_decay`. 1: they are constant.
        position_noise: strength of the random steps of almost transparent Gaussians, relative to the position
            rate (3DGS-MCMC's noise, with lengths relative to extent); 0: none.
    """

    position: Share = 1.6e-4
    sh_dc: Rate = 2.5e-3
    opacity: Rate = 2.5e-2
    scale: Rate = 5e-3
    rotation: Rate = 1e-3
    final: Annotated[float, Range(1e-9, 1)] = 1.0
    position_noise: Annotated[float, Range(0, 1e12)] = 0.0


@dataclass(frozen=True)
class LossConfig:
    """(1 - ssim) L1 + ssim (1 - SSIM) + scale L_scale + opacity L_opacity per view.

    Attributes:
        ssim: weight of the SSIM term.
        opacity: weight of the mean opacity of the visible Gaussians (3DGS-MCMC takes the mean of all
            Gaussians; here the term does not act on Gaussians that a step does not see).
        opacity_total: weight of the same mean beside the sum of the losses of all training views. A run
            minimises the mean of these losses, so a new run sets `opacity` to this weight divided by the
            number of training views, from 0.005 to 0.05. The run's own configuration has the result in
            `opacity`, and 0 here. 0: `opacity` is the weight.
        scale: weight of the mean smallest axis of the visible Gaussians, in units of ten times the extent.
    """

    ssim: Share = 0.2
    opacity: Amount = 0.0
    opacity_total: Amount = 0.0
    scale: Amount = 10.0


@dataclass(frozen=True)
class PopulationConfig:
    """Density control: which Gaussians are cloned, split and pruned, and the two importance passes.

    Some fields have no effect on some runs. With "relocation": `grad_threshold`, `clone_scale`,
    `min_observations` and `phi`. With "density": `growth`. Without
    `importance`: `score`, `pass1_keep`, `pass2_mass`, `pass2_keep`, `pass2_views` and `phi`. Without `gate`:
    `gate_rate` and `gate_rule`. With the gate "random": `gate_rule`.

    Attributes:
        strategy: what a density event does: "density" (clone and split by gradients, prune) or "relocation"
            (3DGS-MCMC: Gaussians that would be pruned are replaced by copies of others, drawn by opacity, and
            the population grows by `growth`).
        growth: share of the population that "relocation" adds at each event.
        grad_threshold: mean norm of the 2D-mean gradient (half-image units) above which a Gaussian is
            densified.
        clone_scale: Gaussians up to this largest axis (relative to extent) are cloned, larger ones split; 0:
            all are split.
        min_opacity: Gaussians of lower opacity are pruned.
        prune_screen_radius: Gaussians with a larger radius, in pixels, are pruned after
            `schedule.size_prune_after`.
        prune_world_scale: Gaussians with a larger axis, relative to extent, are pruned after the same time.
            With `model.random_background` they are not: at each step, axes are limited to this share of the
            extent, or of the distance from the middle of the cameras where that is larger. 0: no limit.
        max_gaussians: largest population. The initial Gaussians are thinned to it (whole octree levels are
            kept, from the coarsest on, and a random part of the next); later the candidates with the largest
            gradients are densified first. 0: no limit.
        importance: at `schedule.t1` and `schedule.t2` score all Gaussians by their contributions to the
            training views, and prune those of low score.
        score: the score of the passes, summed over the views: "density" (BlitzGS: contribution per pixel),
            "weight" (contribution), "root" (contribution over the square root of the number of pixels) or
            "energy" (sum of the squared contributions to pixels).
        pass1_keep: share of the Gaussians that the first pass keeps, drawn in proportion to their scores; 1:
            it keeps all and only computes phi and the cull matrix.
        pass2_mass: the second pass keeps the fewest Gaussians that hold this share of the total score,
            without those below `min_opacity`. 1: it keeps all whose score is not zero.
        pass2_keep: largest share of the Gaussians that the second pass keeps, those of the highest scores,
            without those below `min_opacity`; 1: no such limit. If `pass2_mass` and `pass2_keep` are both 1,
            the pass keeps all Gaussians and only computes phi and the cull matrix.
        pass2_views: with fewer training views the second pass keeps all Gaussians, because scores add up what
            the views show, and say little about places that few of them see.
        phi: from the first pass on, density control multiplies the gradients that it sums with phi: among the
            views that see a Gaussian, the share of those in which it counts.
        gate: model file of a spawn gate (`blitzgs gate fit`), or "default" for the one that comes with
            BlitzGS, for configs/density.yaml with schedule.t1=8999, pass1_keep=0.85 and score=weight; or
            "random" to withhold as many at random, which a gate has to surpass; null: none.
        gate_rate: share of the candidates, clones and splits apart, that the gate withholds at each density
            event from `schedule.gate_from` on.
        gate_rule: "rank" (BlitzGS): the gate withholds the candidates of lowest rank, or "sample": those that
            it lets pass are drawn in proportion to their odds to survive.
        lineage: log every birth and death as Parquet files in the run's folder `lineage` (needs pyarrow).
        pixels_per_gaussian: limits the population to the pixels of all training photographs divided by this.
            0: no limit.
        gaussians_per_point: limits the population to the points of the reconstruction times this; there are
            more points where photographs show more detail. 0: no limit.
        min_observations: a Gaussian is judged by the mean of at least this many gradients, one for each view
            of a step that sees it. With fewer, its gradients are kept for the next density event.
    """

    strategy: Literal["density", "relocation"] = "density"
    growth: Rate = 0.05
    grad_threshold: Annotated[float, Range(0, 1e30)] = 2e-4
    clone_scale: Amount = 0.01
    min_opacity: Annotated[float, Range(0, 1, high_open=True)] = 0.005
    prune_screen_radius: Amount = 20.0
    prune_world_scale: Amount = 0.1
    max_gaussians: Annotated[int, Range(0, 1e11)] = 0
    importance: bool = False
    score: ScoreRule = "density"
    pass1_keep: Kept = 0.7
    pass2_mass: Kept = 0.99
    pass2_keep: Kept = 1.0
    pass2_views: Annotated[int, Range(0, 1e6)] = 0
    phi: bool = True
    gate: str | None = None
    gate_rate: Share = 0.6
    gate_rule: Literal["rank", "sample"] = "rank"
    lineage: bool = False
    pixels_per_gaussian: Annotated[float, Range(0, 1e9)] = 24.0
    gaussians_per_point: Amount = 0.0
    min_observations: Annotated[int, Range(1, 1e6)] = 1


@dataclass(frozen=True)
class ViewConfig:
    """Which Gaussians a view leaves out before projection.

    Attributes:
        lod: from `schedule.densify_until` on, views leave out Gaussians that are too small for their
            distance. The trained model is evaluated and rendered in the same way. Views that would keep at
            least 80 % of all Gaussians are rendered with all of them. With "smooth", opacities fade out over
            half a level around the distance of the cut, and all views have the gate.
        footprint: the smallest footprint that `lod` keeps: opacity times size in pixels of a training view.
            0: a Gaussian is as small as the octree voxel that it descends from, as in the paper.
        cull: from the first importance pass on, a training view leaves out the Gaussians that did not count
            in it at the last pass. This ends halfway between the last pass and the end of the run. Needs
            `population.importance`.
    """

    lod: str | bool = False
    footprint: Annotated[float, Range(0, 1000)] = 0.0
    cull: bool = False


@dataclass(frozen=True)
class MemoryConfig:
    """Where the Gaussians are stored during training; only `tour` changes the result beyond rounding.

    Attributes:
        resident_gb: gigabytes of each rank's device for Gaussians. All Gaussians are stored in host memory,
            and those that the next views may see are copied to the device. 0: all are stored on the device.
        tour: with `resident_gb`, the views of an epoch come along a tour of the places that they show, from
            another place each time and shuffled over an eighth of it, so that most of what they see is
            on the device already. false: in random order.
    """

    resident_gb: Amount = 0.0
    tour: bool = False


@dataclass(frozen=True)
class RanksConfig:
    """How several processes share a run; no field changes the result beyond rounding.

    Attributes:
        timeout_seconds: the job ends if a rank does not arrive at a collective within this time.
        transport: how splats are sent: "peer" (written to the other GPUs' memory), "collective" (by NCCL or
            Gloo) or "auto" ("peer" if it works, else "collective").
    """

    timeout_seconds: Annotated[float, Range(1, 1e6)] = 120.0
    transport: Transport = "auto"


@dataclass(frozen=True)
class LogConfig:
    """What a run logs and saves.

    Attributes:
        every: images between two log records.
        tensorboard: also write TensorBoard events, if the package is installed.
        checkpoint_seconds: seconds between two checkpoints; a crash loses at most this much training. 0: no
            checkpoints by wall time.
        keep_checkpoints: number of checkpoints that are kept on disk.
    """

    every: Interval = 100
    tensorboard: bool = True
    checkpoint_seconds: Annotated[float, Range(0, 1e9)] = 600.0
    keep_checkpoints: Annotated[int, Range(1, 1e6)] = 3


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run computes.

    Attributes:
        seed: seed of the batch order and of every random draw.
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
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the field, the value and the remedy."""
