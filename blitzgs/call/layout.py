# SPDX-License-Identifier: Apache-2.0
"""Arranges a call's splats for `meta`: one after the other, or as [..., C, N, ...] for all Gaussians.

The ops order splats by Gaussian, then view; packed `meta` orders them by image, then Gaussian. As in gsplat,
the image depends on the tensors in `meta`, so that these get gradients. Its kernels nevertheless read the
splats in the order in which they are, and only gradients pass through the arrangement.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from blitzgs.ops.arrange_splats import Places
from blitzgs.ops.projection_types import ProjectedSplats


class Layout:
    """The arrangement of P splats in `meta`.

    Attributes:
        splats: the splats; camera_ids number all images of the call, gaussian_ids the Gaussians of a scene.
        packed: whether `meta` has only the visible splats, or else an entry for every Gaussian and view.
        places: where each splat is in `meta`; None: the order is unchanged.
    """

    def __init__(self, splats: ProjectedSplats, shape: tuple[int, ...], packed: bool) -> None:
        """Compute the arrangement.

        Args:
            splats: as the attribute.
            shape: batch dimensions, C, and the Gaussians N of a scene.
            packed: as the attribute.
        """
        self.splats, self.packed = splats, packed
        self.places: Places | None = None
        if not packed:
            self.places = Places((splats.camera_ids, splats.gaussian_ids), shape)
        elif math.prod(shape[:-1]) > 1:
            order = torch.sort(splats.camera_ids, stable=True)[1]
            self.places = Places((order,), tuple(order.shape))

    def arrange(self, *columns: Tensor, under: Tensor | None = None) -> tuple[Tensor, ...]:
        """Arrange columns of splats as `Places.arrange` does."""
        return columns if self.places is None else self.places.arrange(columns, under)

    def gather(self, *arranged: Tensor) -> tuple[Tensor, ...]:
        """Gather the columns of the splats from arranged ones; the inverse of `arrange`."""
        return arranged if self.places is None else self.places.gather(arranged)

    def rendered_columns(self, under: Tensor | None) -> dict[str, Tensor]:
        """Arrange the columns that the image depends on.

        Args:
            under: opacities of the Gaussians, [..., N], where they have no splat; None: zero.
        """
        splats = self.splats
        columns = (splats.means2d, splats.conics, splats.depths, splats.opacities)
        means2d, conics, depths, opacities = self.arrange(*columns, under=under)
        return {"means2d": means2d, "conics": conics, "opacities": opacities, "depths": depths}

    def absgrad_teller(self, means2d: Tensor) -> Callable[[Tensor], None]:
        """Set `means2d.absgrad` to 0; return a function that fills it with the splats' gradients, [P, 2]."""
        absgrad = torch.zeros_like(means2d)
        means2d.absgrad = absgrad  # type: ignore[attr-defined]

        def tell(gradient: Tensor) -> None:
            absgrad.copy_(self.arrange(gradient)[0])

        return tell
