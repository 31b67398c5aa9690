# SPDX-License-Identifier: Apache-2.0
"""Digests by which two runs tell whether they have the same capture."""

from __future__ import annotations

import hashlib
import os

from blitzgs.capture.capture import Capture


def capture_fingerprint(capture: Capture) -> str:
    """Return a digest of the cameras, the points and the split."""
    digest = hashlib.sha256()
    for camera in capture.cameras:
        digest.update(os.fsencode(f"{camera.name} {camera.width} {camera.height}"))
        digest.update(camera.K.tobytes() + camera.world_to_camera.tobytes())
    digest.update(capture.points.tobytes() + capture.colors.tobytes())
    digest.update(repr((capture.train, capture.test)).encode())
    return digest.hexdigest()[:12]


def train_views_fingerprint(capture: Capture) -> str:
    """Return a digest of the names of the training views, in their order."""
    names = [capture.cameras[index].name for index in capture.train]
    return hashlib.sha256(repr(names).encode()).hexdigest()[:12]
