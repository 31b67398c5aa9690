# SPDX-License-Identifier: Apache-2.0
"""Almost transparent Gaussians wander, so that they find a place where the photographs need them."""

from __future__ import annotations

from torch import Tensor

from blitzgs.model import GaussianTable
from blitzgs.ops.position_noise import position_noise_


class PositionNoise:
    """The noise term of 3DGS-MCMC (Kheradmand et al. 2024, eq. 8), for the Gaussians that a step sees.

    Their noise is a length times the position rate times a squared length; divided by the squared extent it
    no longer depends on the unit of the world.
    """

    def __init__(self, factor: float, extent: float, threshold: float, seed: int) -> None:
        """Prepare the noise of a run.

        Args:
            factor: `optimiser.position_noise`.
            extent: of the scene, in the unit of the means.
            threshold: opacity at which half of the noise is left; Gaussians below it are pruned.
            seed: of the run.
        """
        self._factor, self._extent = factor, extent
        self._threshold, self._seed = threshold, seed

    def add(self, table: GaussianTable, visible_ids: Tensor, step: int, position_rate: float) -> None:
        """Move the rows `visible_ids` (int32 [U]), whose parameters stand at `step` (from 1).

        `position_rate` is the step's learning rate of the means, in their unit.
        """
        position_noise_(
            table["means"],
            table["quats"],
            table["scales"],
            table["opacities"],
            table["id"],
            visible_ids,
            seed=self._seed,
            step=step,
            threshold=self._threshold,
            strength=self._factor * position_rate / self._extent**2,
        )
