# SPDX-License-Identifier: Apache-2.0
"""A stand-in for a browser: opens the viewer's page, orbits, and counts the pictures that arrive."""

from __future__ import annotations

import json
import math
import sys
import time

import msgspec.msgpack
import numpy as np
import websockets.exceptions
import zstandard
from viser.transforms import SO3
from websockets.sync.client import connect

# As often as viser's page sends a moving camera.
CAMERAS_A_SECOND = 50


def camera_message(angle: float, radius: float, height: float, middle: list[float], size: list[int]) -> bytes:
    """Return viser's message of a camera on a circle that looks at its middle."""
    place = np.array(middle) + [radius * math.sin(angle), -radius * math.cos(angle), height]
    forward = np.array(middle) - place
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return msgspec.msgpack.encode(
        {
            "type": "ViewerCameraMessage",
            "wxyz": SO3.from_matrix(rotation).wxyz.tolist(),
            "position": place.tolist(),
            "image_height": size[1],
            "image_width": size[0],
            "fov": math.radians(50),
            "near": 0.01,
            "far": 1000.0,
            "look_at": middle,
            "up_direction": [0.0, 0.0, 1.0],
        }
    )


def pictures_in(message: bytes) -> list[int]:
    """Return the bytes of each picture in a message of viser's server."""
    length = int.from_bytes(message[8:16], "little")
    content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(message[16 : 16 + length]))
    sizes = content["binaryBufferLengths"]
    found = []
    for part in content["messages"]:
        data = part.get("rgb_data")
        if part["type"] == "BackgroundImageMessage" and data is not None:
            found.append(sizes[data["__binary_index"]] if isinstance(data, dict) else len(data))
    return found


def main() -> None:
    """Orbit for some seconds; print what arrived as JSON. Arguments: a JSON object."""
    options = json.loads(sys.argv[1])
    address = options["url"].replace("http://", "ws://")
    with connect(
        address,
        subprotocols=[f"viser-v{options['version']}"],
        max_size=None,
        compression=None,
        open_timeout=30,
    ) as socket:
        begin = time.monotonic()
        end = begin + options["warm_up"] + options["seconds"]
        sent, arrived = begin, []
        while (now := time.monotonic()) < end:
            if now >= sent:
                sent = max(sent + 1 / CAMERAS_A_SECOND, now)
                angle = 0.3 * (now - begin)
                place = (options[name] for name in ("radius", "height", "middle", "size"))
                socket.send(camera_message(angle, *place))
            try:
                message = socket.recv(timeout=max(0.0, min(end, sent) - time.monotonic()))
            except TimeoutError:
                continue
            except websockets.exceptions.ConnectionClosed:
                break
            arrived += [(time.monotonic() - begin, size) for size in pictures_in(message)]
    timed = [(at, size) for at, size in arrived if at > options["warm_up"]]
    gaps = np.diff([at for at, _ in timed]) if len(timed) > 1 else np.array([math.nan])
    print(
        json.dumps(
            {
                "pictures": len(timed),
                "delivered_fps": len(timed) / options["seconds"],
                "median_gap_ms": 1000 * float(np.median(gaps)),
                "worst_gap_ms": 1000 * float(np.max(gaps)),
                "kb_each": float(np.mean([size for _, size in timed])) / 1000 if timed else 0.0,
            }
        )
    )


if __name__ == "__main__":
    main()
