# SPDX-License-Identifier: Apache-2.0
"""The one loop that starts a frame again if its memory was too small; every renderer runs in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from blitzgs._library import below_autograd
from blitzgs.frame.transport.protocol import Exchange, ExchangeResult, Mark, Transport, unmarked
from blitzgs.ops.projection_types import ProjectionInputs, Sizes

if TYPE_CHECKING:
    from blitzgs.frame.tiles import TileAssignment

# A failed attempt reports the sizes that it needs, and the next attempt uses them. More attempts than this
# mean that the inputs change or that the program is wrong.
MAX_ATTEMPTS = 4

Consumed = TypeVar("Consumed")


def run(
    transport: Transport,
    inputs: ProjectionInputs | Callable[[Sizes | None], ProjectionInputs],
    assignment: TileAssignment | None,
    consume: Callable[[Exchange], Consumed],
    mark: Mark = unmarked,
) -> tuple[ExchangeResult, Consumed]:
    """Project, send the splats and consume them, without gradients, until all results had enough memory.

    Args:
        transport: sends the splats, and estimates the sizes.
        inputs: of the projection; or a function that returns them, given the estimated sizes (None: the
            sizes are not known, and the work waits for them).
        assignment: the tiles of each rank; None: one rank composites all.
        consume: queues the work with the splats that have arrived.
        mark: called at the end of the stages "project" and "exchange".

    Returns:
        The splats, cut to their numbers, and what `consume` returned for them.

    Raises:
        RuntimeError: `MAX_ATTEMPTS` attempts did not suffice, each with the sizes that the last one
            needed.
    """
    for _ in range(MAX_ATTEMPTS):
        sizes = None if transport.capacity is None else transport.capacity.sizes
        given = inputs(sizes) if callable(inputs) else inputs
        # Skip autograd: for an op with a registered gradient formula, its Python takes 20 us of host time.
        with below_autograd():
            exchange = transport.project_and_send(given, assignment, sizes, mark)
            consumed = consume(exchange)
            needed, result = exchange.finish()
        if transport.capacity is not None:
            transport.capacity.learn(needed)
        if result is not None:
            return result, consumed
        del exchange, consumed  # before the next attempt takes as much memory again
    raise RuntimeError(
        f"{MAX_ATTEMPTS} attempts have each needed more than the one before had asked for: the last had "
        f"{sizes} and needs {tuple(needed)}. The inputs must not change during a call"
    )
