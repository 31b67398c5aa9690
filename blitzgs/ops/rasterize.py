# SPDX-License-Identifier: Apache-2.0
"""Rasterisation: front-to-back alpha compositing of splats, tile by tile, and its gradient.

Also the gradients of splats, in the two layouts in which compositing hands them to the projection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.derivatives import first_only
from blitzgs.ops.intersect import TILE_SIZE, TileGrid
from blitzgs.util.errors import check_tensors

# Where the parts of a splat gradient begin in its floats (csrc/common/kernel.h), and how many these are.
_MEAN2D, _CONIC, _OPACITY, _COLOR, _MEAN2D_ABS, SPLAT_GRADIENT = torch.ops.blitzgs.splat_gradient_layout()

# The attribute by which a column carries the table that it is a part of, and its number among the columns.
_TABLE = "_blitzgs_gradient_table"
# For alphas = 1 - transmittances. With the number 1, torch would first make a tensor of it, which takes 5 us
# of the host's time. A tensor without dimensions on the CPU combines with tensors of any device and dtype.
_ONE = torch.ones((), device="cpu")

Arrange = Callable[[Sequence[Tensor]], Sequence[Tensor]]


class MetaGeometry(NamedTuple):
    """The geometry of splats in the arrangement of `meta`, whose tensors get the gradients.

    `rasterize` composites the splats themselves. Its backward pass arranges the gradients of their geometry
    and gives them to these tensors, so that a caller finds them in `.grad` of `meta["means2d"]`.
    """

    arrange: Arrange  # arranges columns of splats
    columns: Sequence[Tensor]  # means2d, conics and splat_opacities in it


def rasterize(
    means2d: Tensor,
    conics: Tensor,
    splat_opacities: Tensor,
    colors: Tensor,
    isect_splats: Tensor,
    tile_offsets: Tensor,
    *,
    n_cameras: int,
    width: int,
    height: int,
    tile_size: int = TILE_SIZE,
    backgrounds: Tensor | None = None,
    tile_begin: int = 0,
    tile_end: int = -1,
    store_absgrad: Callable[[Tensor], object] | None = None,
    composited: Sequence[Tensor] | None = None,
    meta_geometry: MetaGeometry | None = None,
) -> tuple[Tensor, Tensor]:
    """Composite the splats of each tile's list into images.

    Per pixel, in list order, with d from the splat's mean to the pixel centre (i + 0.5, j + 0.5):

        alpha = min(0.99, opacity * exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2)), skipped below 1/255
        the pixel ends before T (1 - alpha) would fall below 1e-4
        color += alpha T splat_color;  T *= 1 - alpha

    and the background is added with the remaining T. The function is differentiable in means2d, conics,
    splat_opacities, colors and backgrounds. No gradient flows through clipped alphas, the order of the splats
    and the two cuts. Gradients repeat bit for bit on the CPU, and on CUDA under
    ``torch.use_deterministic_algorithms(True)``.

    Args:
        means2d: [P, 2], pixels, float32 or (CPU) float64.
        conics: inverse 2D covariances (a, b, c) [P, 3].
        splat_opacities: [P].
        colors: [P, D], D from 1 to 4096.
        isect_splats: int32 [I], from `blitzgs.ops.intersect.intersect`.
        tile_offsets: int64 [B * T + 1], from the same call.
        n_cameras, width, height, tile_size, tile_begin, tile_end: as given to ``intersect``; the pixels of
            tiles outside [tile_begin, tile_end) are zero.
        backgrounds: [B, D], or None for black.
        store_absgrad: the backward pass calls it with the sum over pixels of the absolute gradient of
            means2d, per axis, [P, 2], whichever gradients it computes.
        composited: the result of the op `rasterize_fwd` for these arguments and alphas, if they are already
            known; None: call the op.
        meta_geometry: the same means2d, conics and splat_opacities as `meta` has them, which get the
            gradients in their place; not under `torch.compile`.

    Returns:
        Renders [B, H, W, D] and alphas [B, H, W].

    Raises:
        TypeError: an argument is not a tensor.
        RuntimeError: wrong shapes or dtypes, or a tile range outside the images; on the CPU also lists of
            other splats.
        ValueError: `store_absgrad` under `torch.compile`.
    """
    if composited is None:
        check_tensors(
            means2d=means2d, conics=conics, splat_opacities=splat_opacities, colors=colors,
            isect_splats=isect_splats, tile_offsets=tile_offsets,
        )  # fmt: skip
    splats = (means2d, conics, splat_opacities, colors, backgrounds, isect_splats, tile_offsets)
    grid = TileGrid(n_cameras, width, height, tile_size, tile_begin, tile_end)
    if torch.compiler.is_compiling():
        if store_absgrad is not None:
            raise ValueError("absolute gradients are not supported under torch.compile")
        renders, transmittances, *_ = torch.ops.blitzgs.rasterize_fwd(*splats, *grid, True, False, None)
        alphas = 1 - transmittances
    else:
        geometry = (means2d, conics, splat_opacities) if meta_geometry is None else meta_geometry.columns
        arrange = None if meta_geometry is None else meta_geometry.arrange
        # Whether a table for the gradients is prepared, see `_gradients`.
        backward_follows = (
            composited is None
            and store_absgrad is None
            and torch.is_grad_enabled()
            and any(x.requires_grad for x in (*geometry, colors))
        )
        call = _Call(splats, grid, store_absgrad, arrange, backward_follows, composited)
        renders, alphas = _Rasterize.apply(*geometry, colors, backgrounds, call)  # type: ignore[no-untyped-call]
    if (tile_begin, tile_end) != (0, -1):
        alphas = alphas * grid.owned_pixels(alphas.device)
    return renders, alphas


def gradient_columns(table: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """View a table of splat gradients as columns, from which `gradient_table_of` takes the table.

    `table`: [P, 12], as the op `rasterize_bwd` fills it. Returns gradients of means2d [P, 2], conics [P, 3],
    opacities [P] and colors [P, 3].
    """
    columns = (
        table[:, _MEAN2D : _MEAN2D + 2],
        table[:, _CONIC : _CONIC + 3],
        table[:, _OPACITY],
        table[:, _COLOR : _COLOR + 3],
    )
    for number, column in enumerate(columns):
        setattr(column, _TABLE, (table, number))
    return columns


def gradient_table_of(columns: Sequence[Tensor | None]) -> Tensor | None:
    """Return the table of which `columns` are the `gradient_columns`; None if they are not of one table.

    Autograd hands these columns on as they are, unless something else has a part in a gradient (a second use
    of the splats, a hook): it is then another tensor, which carries no table.
    """
    table, _ = getattr(columns[0], _TABLE, (None, 0))
    parts = (getattr(column, _TABLE, (None, 0)) for column in columns)
    return table if all(of is table and i == n for i, (of, n) in enumerate(parts)) else None


class SplatGradients(NamedTuple):
    """Gradients of P splats in one of two forms."""

    # v_means2d [P, 2], v_conics [P, 3], v_opacities [P], v_colors [P, 3]; or (CUDA) one table [P, 12]
    parts: Sequence[Tensor]

    @property
    def means2d(self) -> Tensor:
        """The gradient of means2d, [P, 2] per pixel."""
        first = self.parts[0]
        return first[:, _MEAN2D : _MEAN2D + 2] if len(self.parts) == 1 else first

    def side_by_side(self) -> Tensor:
        """Return all columns as one [P, 9]."""
        flat = [column.reshape(len(column), math.prod(column.shape[1:])) for column in self._columns()]
        return torch.cat(flat, 1)

    def sum_returned(self, values: Sequence[Tensor], places: Tensor, splats: int) -> SplatGradients:
        """Return the gradients of P own splats, summed over the ranks in their order; zero if sent nowhere.

        `values`: [n, F] of each rank, the rows of its `side_by_side` for this rank's splats. `places`: from
        `blitzgs.ops.exchange.scatter_splats`.
        """
        columns = self._columns()
        widths = [math.prod(column.shape[1:]) for column in columns]
        sums = torch.ops.blitzgs.sum_splats(values, places, splats, widths)
        return SplatGradients(
            [total.reshape(-1, *like.shape[1:]) for total, like in zip(sums, columns, strict=True)]
        )

    def _columns(self) -> Sequence[Tensor]:
        """Return the four columns."""
        return gradient_columns(self.parts[0]) if len(self.parts) == 1 else self.parts


class RasterizeSaved(NamedTuple):
    """What a forward pass saves for the ops of the backward pass, in the groups that these take."""

    splats: Sequence[Tensor]  # means2d [P, 2], conics [P, 3], splat_opacities [P], colors [P, D]
    backgrounds: Tensor | None  # [B, D]; None: black
    # isect_splats, int32 [I], by tile, front to back; tile_offsets, int64 [B T + 1], where each begins
    lists: Sequence[Tensor]
    # transmittances [B, H, W]; last_ids, int32 [B, H, W], where each pixel's list ended; packed_splats and
    # tile_order, in layouts that only the kernels of the backend read.
    composited: Sequence[Tensor]


@dataclass
class GradientBuffer:
    """Memory in which the CUDA backward pass sums the gradients of splats; the forward pass has zeroed it.

    It serves one backward pass; each later one gets other memory.
    """

    zeros: Tensor | None  # [P or more, 12], the last output of `rasterize_fwd`; [0, 12] or None: none
    # zeroes memory for later backward passes; without it, or if it returns None, some is allocated
    others: Callable[[], Tensor | None] | None = None

    def take(self, means2d: Tensor) -> Tensor:
        """Return zeros [P, 12] for the P splats."""
        zeros, self.zeros = self.zeros, None
        count = means2d.shape[0]
        if zeros is not None and zeros.shape[0] >= count:
            return zeros if zeros.shape[0] == count else zeros[:count]
        others = None if self.others is None else self.others()
        return means2d.new_zeros(count, SPLAT_GRADIENT) if others is None else others


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    _, _, *others = output
    ctx.mark_non_differentiable(*others)
    splats, grid = inputs[:7], TileGrid(*inputs[7:13])
    _save(ctx, splats, grid, output)


def _save(ctx: Any, splats: Any, grid: Any, output: Sequence[Tensor]) -> None:
    # The renders are not saved: callers may change them in place, and the backward pass does not need them.
    _, transmittances, last_ids, _, packed_splats, tile_order, splat_gradients = output
    ctx.set_materialize_grads(False)
    ctx.gradients = GradientBuffer(splat_gradients)
    ctx.save_for_backward(*splats, transmittances, last_ids, packed_splats, tile_order)
    ctx.grid = grid


def _backward(
    ctx: Any, v_renders: Tensor | None, v_transmittances: Tensor | None, *_: Tensor | None
) -> tuple[Tensor | None, ...]:
    v_alphas = None if v_transmittances is None else -v_transmittances
    *splat_gradients, _absolute = _gradients(ctx, v_renders, v_alphas, absgrad=False)
    return (*splat_gradients, *[None] * 11)  # for the lists, the grid and three options


def _gradients(
    ctx: Any, v_renders: Tensor | None, v_alphas: Tensor | None, absgrad: bool, may_be_table: bool = False
) -> Sequence[Tensor | None]:
    """Return the gradients of means2d, conics, splat_opacities, colors and backgrounds.

    A sixth value follows: the sum over pixels of the absolute gradient of means2d; None without `absgrad`.
    With `may_be_table`, the gradients of the splats may, on CUDA, be columns of one table, which
    `project_bwd` reads without copying.
    """
    if v_renders is None and v_alphas is None:
        return (None,) * 6
    tensors = ctx.saved_tensors  # read once: checkpointing recomputes them at each reading
    saved = RasterizeSaved(tensors[:4], tensors[4], tensors[5:7], tensors[7:])

    def compute() -> Sequence[Tensor | None]:
        (means2d, _, _, colors), (transmittances, *_) = saved.splats, saved.composited
        v_image = v_renders
        if v_image is None:
            v_image = transmittances.new_zeros(*transmittances.shape, colors.shape[1])
        deterministic = torch.are_deterministic_algorithms_enabled()
        table = v_backgrounds = None
        if may_be_table and colors.is_cuda and colors.shape[1] == 3 and v_alphas is None and not absgrad:
            table = ctx.gradients.take(means2d)
        *v_splats, v_abs = torch.ops.blitzgs.rasterize_bwd(
            *saved, v_image, v_alphas, *ctx.grid, absgrad, deterministic, table
        )
        if table is not None:
            v_splats = gradient_columns(table)
        if ctx.needs_input_grad[4]:
            # A matrix product would be of less precision under autocast.
            v_backgrounds = (v_image * transmittances[..., None]).sum(dim=(1, 2))
        return (*v_splats, v_backgrounds, v_abs if absgrad else None)

    return first_only("rasterize", compute, (*saved.splats, saved.backgrounds, v_renders, v_alphas))


class _Call(NamedTuple):
    """The arguments of `rasterize` that `_Rasterize` takes as one, because each argument takes host time."""

    splats: tuple[Any, ...]  # the tensors that the op takes
    grid: TileGrid
    store_absgrad: Callable[[Tensor], object] | None
    arrange: Arrange | None
    backward_follows: bool
    composited: Sequence[Tensor] | None


class _Rasterize(torch.autograd.Function):
    """Renders and alphas for calls outside of `torch.compile`, with the gradient formula registered below.

    Calling an op with a registered formula through torch takes 0.2 ms of the host's time.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        *_, call = arguments
        if call.composited is None:
            with below_autograd():  # not the formula below: its Python takes 20 us of the host's time
                output = torch.ops.blitzgs.rasterize_fwd(
                    *call.splats, *call.grid, True, call.backward_follows
                )
            alphas = _ONE - output[1]
        else:
            *output, alphas = call.composited
        _save(ctx, call.splats, call.grid, output)
        ctx.store_absgrad, ctx.arrange = call.store_absgrad, call.arrange
        return output[0], alphas

    @staticmethod
    def backward(ctx: Any, *v_output: Tensor | None) -> tuple[Tensor | None, ...]:
        v_renders, v_alphas = v_output
        store = ctx.store_absgrad
        *splat_gradients, v_abs = _gradients(ctx, v_renders, v_alphas, store is not None, may_be_table=True)
        if v_abs is not None:
            store(v_abs.detach())
        if ctx.arrange is not None and splat_gradients[0] is not None:
            splat_gradients[:3] = ctx.arrange(splat_gradients[:3])
        return (*splat_gradients, None)


torch.library.register_autograd("blitzgs::rasterize_fwd", _backward, setup_context=_setup_context)
