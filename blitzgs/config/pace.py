# SPDX-License-Identifier: Apache-2.0
"""Maps times of the configuration to images of the run, for runs that change their pace."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import torch
from torch import Tensor


class Pace:
    """An increasing, piecewise linear map from times of the configuration to images of the run, and back.

    A later change of pace does not change any bit of the map before it.
    """

    def __init__(self, scale: float, changes: Sequence[tuple[int, float]]) -> None:
        """Make the map.

        Args:
            scale: images of the run per image of the configuration, before the first change.
            changes: pairs (image of the run, factor) with increasing images above 0: from that image on, the
                ratio is `scale` times the factor.
        """
        self._images = [0.0, *(float(image) for image, _ in changes)]
        self._scales = [scale, *(scale * factor for _, factor in changes)]
        self._times = [0.0]
        for begin, end, rate in zip(self._images, self._images[1:], self._scales, strict=False):
            self._times.append(self._times[-1] + (end - begin) / rate)

    @property
    def scale(self) -> float:
        """Images of the run per image of the configuration, after the last change."""
        return self._scales[-1]

    def image(self, time: float) -> float:
        """Return the image of the run at a time >= 0 of the configuration."""
        piece = bisect_right(self._times, time) - 1
        return self._images[piece] + (time - self._times[piece]) * self._scales[piece]

    def time(self, image: float) -> float:
        """Return the time of the configuration at an image >= 0 of the run."""
        piece = bisect_right(self._images, image) - 1
        return self._times[piece] + (image - self._images[piece]) / self._scales[piece]

    def times(self, images: Tensor) -> Tensor:
        """Return `time` of each element of a float64 tensor [...]."""
        begins, times, scales = torch.tensor([self._images, self._times, self._scales], dtype=torch.float64)
        piece = torch.bucketize(images, begins, right=True) - 1
        return times[piece] + (images - begins[piece]) / scales[piece]
