# SPDX-License-Identifier: Apache-2.0
"""Stops a run whose losses or parameters are not finite, and names where the first such value is."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.host_sum import HostSum
from blitzgs.frame.render import Frame
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.util.errors import UserError


class NonFiniteError(UserError):
    """A value is NaN or infinite; the message names the step, the view, and the op or column."""


class ModelLostError(UserError):
    """No Gaussian is left; the message names a remedy."""


class LossGuard:
    """Checks every step's loss: at once on the CPU, one step later on CUDA, to avoid a wait."""

    def __init__(self) -> None:
        self._pending: tuple[int, Sequence[str], HostSum] | None = None

    def check(
        self, step: int, names: Sequence[str], sums: HostSum, table: GaussianTable, frame: Frame
    ) -> None:
        """Check the losses of the B views `names` in step `step`; on CUDA, those of the step before.

        `sums` are their `LossTerms.parts` over all ranks, [2 B]; further values are ignored. NonFiniteError:
        one is not finite.
        """
        if frame.renders.device.type != "cuda":
            _check_loss(step, names, sums, lambda: _origin(step, None, table, frame, names))
            return
        previous, self._pending = self._pending, (step, names, sums)
        if previous is not None:
            _check_loss(*previous, lambda: _origin(previous[0], step, table, frame, names))


def _check_loss(step: int, names: Sequence[str], sums: HostSum, origin: Callable[[], str]) -> None:
    # Plain Python numbers: this runs in every step while the GPU waits, and one torch op would take longer.
    values = sums.read().numpy()[: 2 * len(names)].tolist()
    # A sum of float32 numbers is within the range of Python's numbers: it is finite if all of them are.
    if not math.isfinite(sum(values)):
        finite = [math.isfinite(value) for value in values]
        l1, ssim = finite[: len(names)], finite[len(names) :]
        views = ", ".join(f"'{name}'" for name, *good in zip(names, l1, ssim, strict=True) if not all(good))
        raise NonFiniteError(f"step {step}: the loss of view {views} is not finite; {origin()}")


def _origin(step: int, later: int | None, table: GaussianTable, frame: Frame, names: Sequence[str]) -> str:
    """Describe where the first non-finite value is, by the table and the frame of the step or a later one."""
    found = _first_in(table, frame, names)
    if later is None:
        return found or "parameters, projected Gaussians and images are finite: it comes from op photometric"
    if found is not None:
        return f"found in step {later}: {found}"
    views = ", ".join(f"'{name}'" for name in names)
    return (
        f"the data of step {step} no longer exist; in step {later} the parameters are finite, and so are "
        f"the projected Gaussians and images of view {views}. It came from op photometric or from a Gaussian "
        "that these views do not see: train on the CPU, where every step is checked at once"
    )


def _first_in(table: GaussianTable, frame: Frame, names: Sequence[str]) -> str | None:
    """Name the column, or the op with the Gaussian and view, of the first value that is not finite."""
    if (culprit := bad_column(table)) is not None:
        return culprit
    splats = frame.projected
    for name in ("means2d", "conics", "depths", "opacities", "colors"):
        bad = ~getattr(splats, name).isfinite().view(len(splats.depths), -1).all(1)
        if bool(bad.any()):
            at = int(bad.nonzero()[0])
            gaussian, view = int(splats.gaussian_ids[at]), int(splats.camera_ids[at])
            return (
                f"it first appears in op project, output {name}: Gaussian id {int(table['id'][gaussian])} in "
                f"view '{names[view]}', and {int(bad.sum()) - 1} more"
            )
    bad, assignment = ~frame.renders.isfinite().all(-1), frame.assignment
    if assignment is not None:
        bad &= assignment.ranges.pixel_mask(assignment.ranks.rank, bad.device)
    if bool(bad.any()):
        view, y, x = bad.nonzero()[0].tolist()
        return f"it first appears in op rasterize, output renders: view '{names[view]}', pixel ({x}, {y})"
    return None


def find_bad(table: GaussianTable, names: Iterable[str] = PARAMETERS) -> Tensor:
    """Return whether some columns have a value that is not finite: int64 [], 1 if so; does not wait."""
    with below_autograd():
        bad: Tensor = torch.ops.blitzgs.find_non_finite([table[name] for name in names], [])
    return bad.long()


def bad_column(table: GaussianTable, names: Iterable[str] = PARAMETERS) -> str | None:
    """Name the first of some columns with a value that is not finite, and its Gaussians; None: all are."""
    names = list(names)
    if not find_bad(table, names):
        return None
    for name in names:
        finite = table[name].isfinite().flatten(1).all(1) if table[name].dim() > 1 else table[name].isfinite()
        if not bool(finite.all()):
            ids = table["id"][~finite]
            shown = ", ".join(str(i) for i in ids[:3].tolist()) + ", ..." * (len(ids) > 3)
            return f"column '{name}' is not finite in {len(ids)} Gaussians (ids {shown})"
    return None


def check_table(table: GaussianTable, step: int, names: Iterable[str] = PARAMETERS) -> None:
    """Check parameters of this rank's Gaussians (NonFiniteError: names step, column and Gaussians)."""
    if (culprit := bad_column(table, names)) is not None:
        remedy = "Lower the learning rates (optimiser.*) or resume from a checkpoint"
        raise NonFiniteError(f"step {step}: {culprit}. {remedy}")


def check_before_saving(table: GaussianTable, step: int, ranks: Ranks) -> None:
    """Check every column that would be saved; every rank calls this, and gets the NonFiniteError of any."""
    floats = [name for name in table if table.row_of(name).dtype.is_floating_point]
    found = ranks.all_gather_object(bad_column(table, floats))
    culprits = [f"rank {rank}: {text}" for rank, text in enumerate(found) if text is not None]
    if culprits:
        raise NonFiniteError(
            f"step {step}: {'; '.join(culprits)}. No checkpoint was written and the earlier ones are kept: "
            "lower the learning rates (optimiser.*) and start again, or resume from the last one"
        )
