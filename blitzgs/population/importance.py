# SPDX-License-Identifier: Apache-2.0
"""The importance passes: a sweep over all training views scores every Gaussian, then some are pruned.

docs/guide/fewer-gaussians.md defines the scores, phi and the cull matrix. The views see the Gaussians of all
ranks. All sums are integers, so every result has the same bits at any world size and for any division of the
work.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from blitzgs.config.fields import ScoreRule
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import decimal_share, integer_mass_prefix, mass_prefix, smallest
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import RenderOptions, Survey, survey
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport import open_transport
from blitzgs.ops.blocks import WORD_BITS
from blitzgs.ops.counter_random import sampling_keys
from blitzgs.ops.importance import ViewSums, view_sums_
from blitzgs.ops.projection_types import Views
from blitzgs.table.table import CULL, GaussianTable
from blitzgs.view.gate import ModelGate
from blitzgs.view.visible import TableOrPool, VisibleFinder, VisibleRows, table_of

# The constants of the formulas. PHI_EPS and VIEW_MASS are the paper's values; the paper calls the
# epsilon of the score small and gives no value.
SCORE_EPS = 1e-6
PHI_EPS = 0.1
VIEW_MASS = 0.99
# Column of a table from the first pass on, beside `CULL`.
PHI = "phi"
# Bits before the binary point of a view's term, for a < 2^31 pixels: w < a < 2^31, so w / a < 1 and
# w / sqrt(a) < sqrt(a) < 2^16. A sum of squares is less than w.
_TERM_BITS: dict[ScoreRule, int] = {"density": 0, "root": 16, "weight": 31, "energy": 31}


class SweepStoppedError(Exception):
    """A sweep was given up because the run has to stop."""


@dataclass(frozen=True)
class ViewBatch:
    """Views of one image size that are surveyed together."""

    columns: Sequence[int]  # the views' columns in the cull matrix, ascending
    views: Views
    keys: Sequence[Hashable] | None = None  # keys of the views in `TileOwners`; None: their columns


@dataclass(frozen=True)
class Importance:
    """The result of a sweep for this rank's N Gaussians."""

    score: Tensor  # float32 [N], summed over the views
    phi: Tensor  # float32 [N], share of the views that see a Gaussian in which it counts, in [0, 1)
    # int32 [N, ceil(V / 32)]; bit v % 32 of word v / 32 is set where the Gaussian does not count in view v.
    # Bits from V on are zero.
    cull: Tensor

    def store(self, table: GaussianTable, with_cull: bool) -> None:
        """Store phi and, if `with_cull`, the cull matrix as columns of the table."""
        table[PHI] = self.phi
        if CULL in table:
            del table[CULL]
        if with_cull:
            table[CULL] = self.cull


def sweep(
    gaussians: TableOrPool,
    batches: Iterable[ViewBatch],
    n_views: int,
    options: RenderOptions,
    ranks: Ranks,
    owners: TileOwners | None = None,
    rule: ScoreRule = "density",
    lod: ModelGate | None = None,
    stops: Callable[[], bool] | None = None,
) -> Importance:
    """Score the Gaussians by their contributions to V views. Collective: every rank calls it.

    `gaussians`: this rank's, without pending optimiser steps. `batches`: the views, each once, in the same
    batches on every rank. `n_views`: V, columns of the cull matrix. `owners`: divides the tiles by their
    costs; the result does not depend on it. `rule`: of the score. `lod`: leaves Gaussians out of views as
    rendering does; there they contribute nothing and hide nothing. `stops`: whether to give up, asked before
    each batch but the first; the same answer on every rank. SweepStoppedError: `stops` said so; the table is
    as it was.
    """
    table = table_of(gaussians)
    sums = _Sums(len(table), n_views, table.device, rule)
    owners = owners or TileOwners(ranks)
    transport, finder = open_transport(ranks), VisibleFinder(gaussians, lod)
    with _SideWork(table.device, ranks.world_size == 1 and gaussians is table) as side:
        for number, batch in enumerate(batches):
            if stops is not None and number > 0 and stops():
                raise SweepStoppedError
            assignment = _assign(batch, owners)
            visible = finder.find(batch.views, options.limits)
            surveyed = survey(
                visible.table, batch.views, options, assignment, transport, visible.active, rule == "energy"
            )
            with side.work(surveyed, visible):
                sums.add(surveyed, batch.columns, visible, ranks)
    return sums.result()


def is_culled(cull: Tensor, column: int) -> Tensor:
    """Return the column of a view, bool [N], of the packed matrix, int32 [N, words]."""
    return (cull[:, column // WORD_BITS] >> (column % WORD_BITS) & 1).bool()


def _assign(batch: ViewBatch, owners: TileOwners) -> TileAssignment | None:
    """Divide the tiles of a batch among the ranks, without a halo, which only a loss needs."""
    if owners.ranks.world_size == 1:
        return None
    views, keys = batch.views, batch.columns if batch.keys is None else batch.keys
    ranges = owners.divide(list(keys), views.width, views.height)
    return TileAssignment(owners.ranks, ranges)


class _SideWork:
    """Runs what follows each survey on a side stream, beside the survey of the next batch.

    That work is many short kernels, most of which leave the GPU idle. When the block ends, for whatever
    reason, the caller's stream waits for all of it.
    """

    def __init__(self, device: torch.device, wanted: bool) -> None:
        """Open a stream on a GPU; on the CPU, or if not `wanted`, the work follows its survey as usual."""
        self._stream = _side_stream(device) if wanted and device.type == "cuda" else None
        self._held: object = None
        self._done: torch.cuda.Event | None = None

    def __enter__(self) -> _SideWork:
        return self

    def __exit__(self, *_error: object) -> None:
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)

    @contextmanager
    def work(self, *held: object) -> Iterator[None]:
        """Queue work that reads tensors of the caller's stream, which `held` must keep alive."""
        if self._stream is None:
            yield
            return
        main = torch.cuda.current_stream(self._stream.device)
        if self._done is not None:
            # Before the memory that the work for the last batch reads is free for the next one.
            main.wait_event(self._done)
        self._held = held
        self._stream.wait_stream(main)
        with torch.cuda.stream(self._stream):
            yield
        self._done = self._stream.record_event()


@lru_cache(maxsize=16)
def _side_stream(device: torch.device) -> torch.cuda.Stream:
    """Return one stream of a GPU for all sweeps: torch keeps freed memory for the stream that had it."""
    return torch.cuda.Stream(device, priority=-1)


class _Sums:
    """The sums over the views surveyed so far, for N Gaussians."""

    def __init__(self, count: int, n_views: int, device: torch.device, rule: ScoreRule) -> None:
        self._rule = rule
        # Terms are integers in a unit for which the sum over all views fits into 62 bits.
        self._unit = 2.0 ** -min(48, 62 - n_views.bit_length() - _TERM_BITS[rule])
        dtypes = (torch.int64, torch.int32, torch.int32)
        score, seen, counted = (torch.zeros(count, dtype=dtype, device=device) for dtype in dtypes)
        self._sums = ViewSums(score, seen, counted, _all_culled(n_views, device).repeat(count, 1))

    def add(self, found: Survey, columns: Sequence[int], surveyed: VisibleRows, ranks: Ranks) -> None:
        """Add the splats of a batch of views."""
        splats, ids = found.splats, surveyed.table["id"]
        counts = integer_mass_prefix(
            found.weights, splats.camera_ids, splats.gaussian_ids, ids, VIEW_MASS, ranks, len(columns)
        )
        home = self._sums.score.device  # where the whole table is
        rows, offsets = surveyed.rows_of(splats.visible_ids).to(home), splats.splat_offsets.to(home)
        lists = rows, offsets, splats.camera_ids.to(home), splats.radii.to(home)
        # The rule "energy" adds up the squares as the rule "weight" adds up the weights, without a divisor.
        terms, rule = (found.weights, self._rule) if found.squares is None else (found.squares, "weight")
        view_sums_(
            self._sums, lists, terms.to(home), found.pixels.to(home), counts.to(home), columns,
            rule=rule, eps=SCORE_EPS, unit=self._unit,
        )  # fmt: skip

    def result(self) -> Importance:
        phi = self._sums.counted.double() / (self._sums.seen.double() + PHI_EPS)
        score = self._sums.score.double() * self._unit
        return Importance(score.float(), phi.float(), self._sums.cull)


def _all_culled(n_views: int, device: torch.device) -> Tensor:
    """Return the row of a Gaussian that counts in no view, int32 [1, words]."""
    bits = np.zeros(-(-n_views // WORD_BITS) * WORD_BITS, dtype=np.uint8)
    bits[:n_views] = 1
    words = np.packbits(bits, bitorder="little").view("<i4")
    return torch.from_numpy(words)[None].to(device)


def sample_by_score(score: Tensor, ids: Tensor, keep: float, seed: int, event: int, ranks: Ranks) -> Tensor:
    """Draw the Gaussians that pass 1 keeps: without replacement, with probability proportional to score.

    The Gaussians with the floor(keep N) smallest values of -log(u) / score are kept (exponential races,
    Efraimidis and Spirakis 2006), where u depends only on (seed, event, id). A Gaussian with score zero is
    kept only if all with positive scores are.

    Args:
        score: float32 [N_rank], >= 0.
        ids: int64 [N_rank], persistent.
        keep: share of all ranks' N Gaussians, in [0, 1]; its decimal value counts.
        event: number that differs between draws, such as the time of the pass.
        ranks: the job; every rank calls this.

    Returns:
        bool [N_rank], the same ids at every world size.
    """
    return smallest(sampling_keys(score, ids, seed, event), ids, _share_of_all(keep, score, ranks), ranks)


def top_by_score(score: Tensor, ids: Tensor, mass: float, keep: float, ranks: Ranks) -> Tensor:
    """Choose the Gaussians that pass 2 keeps: a prefix of the order by descending score.

    Args:
        score: float32 [N_rank], finite, >= 0.
        ids: int64 [N_rank], persistent; they decide between equal scores.
        mass: the prefix is the shortest that holds this share of the total score of all ranks, in [0, 1].
        keep: the prefix has at most floor(keep N) of all ranks' N Gaussians; in [0, 1], its decimal value
            counts.
        ranks: the job; every rank calls this.

    Returns:
        bool [N_rank], the same ids at every world size.
    """
    kept = mass_prefix(score, ids, mass, ranks)
    if keep < 1:
        kept &= smallest(-score, ids, _share_of_all(keep, score, ranks), ranks)
    return kept


def _share_of_all(share: float, rows: Tensor, ranks: Ranks) -> int:
    """Return the floor of a share, by its decimal value, of the rows of all ranks."""
    total = ranks.all_reduce(torch.tensor(len(rows), device=rows.device))
    return math.floor(decimal_share(share) * int(total))
