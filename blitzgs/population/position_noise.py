# SPDX-License-Identifier: Apache-2.0
"""Random noise on the positions of almost transparent Gaussians, which explore the scene (3DGS-MCMC)."""

from __future__ import annotations

from torch import Tensor

from blitzgs.ops.population import position_noise_
from blitzgs.table.table import GaussianTable


class PositionNoise:
    """The noise term of 3DGS-MCMC (Kheradmand et al. 2024, eq. 8), for the Gaussians that a step sees.

    In 3DGS-MCMC, the noise depends on the unit of length, because it contains the covariance, a squared
    length. Here it is divided by the squared extent of the scene, so that it does not.
    """

    def __init__(self, factor: float, extent: float, threshold: float, seed: int) -> None:
        """Prepare the noise of a run.

        Args:
            factor: `optimiser.position_noise`.
            extent: extent of the scene, in the unit of the means.
            threshold: opacity at which the noise falls to a half; Gaussians below it are pruned.
            seed: seed of the run.
        """
        self._factor, self._extent = factor, extent
        self._threshold, self._seed = threshold, seed

    def add(self, table: GaussianTable, visible_ids: Tensor, step: int, position_rate: float) -> None:
        """Add noise to the means of rows `visible_ids` (int32 [U]), which are current up to `step`.

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
