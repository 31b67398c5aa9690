# SPDX-License-Identifier: Apache-2.0
"""Sends projected splats to the ranks that composite them, and returns their gradients."""

from __future__ import annotations

from blitzgs.distributed.group import Ranks
from blitzgs.frame.transport.collective import CollectiveTransport
from blitzgs.frame.transport.peer import PeerTransport
from blitzgs.frame.transport.protocol import LocalTransport, Transport


def open_transport(ranks: Ranks | None) -> Transport:
    """Return the fastest transport of a job, valid until it ends; None: a job of one rank."""
    if ranks is None or ranks.world_size == 1:
        return LocalTransport()
    if ranks.memory is None:
        return CollectiveTransport(ranks)
    return PeerTransport(ranks)
