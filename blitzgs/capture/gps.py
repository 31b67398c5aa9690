# SPDX-License-Identifier: Apache-2.0
"""GPS positions in the EXIF of photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

# Tags of EXIF 2.32, section 4.6.6.
_GPS, _LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = (
    0x8825,
    1,
    2,
    3,
    4,
    5,
    6,
)


def gps_positions(paths: Sequence[Path]) -> list[tuple[float, float, float] | None]:
    """Return longitude, latitude (degrees) and height (metres) of each photograph; None: it has none.

    The height is the receiver's: above the ellipsoid or above sea level, as EXIF does not say.

    Raises:
        ImportError: Pillow, which reads the tags, is not installed.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError('reading EXIF needs Pillow: pip install "blitzgs[geo]"') from error
    found = []
    for path in paths:
        try:
            with Image.open(path) as image:
                found.append(_position(image.getexif().get_ifd(_GPS)))
        except (OSError, ValueError, SyntaxError):  # damaged, or a format without EXIF
            found.append(None)
    return found


def _position(tags: Any) -> tuple[float, float, float] | None:
    try:
        latitude = _degrees(tags[_LATITUDE]) * (-1 if tags[_LATITUDE_REF] == "S" else 1)
        longitude = _degrees(tags[_LONGITUDE]) * (-1 if tags[_LONGITUDE_REF] == "W" else 1)
        altitude = float(tags[_ALTITUDE]) * (-1 if tags.get(_ALTITUDE_REF) in (1, b"\x01") else 1)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    on_earth = abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) < 1e5  # false for NaN
    return (longitude, latitude, altitude) if on_earth and (latitude, longitude) != (0, 0) else None


def _degrees(parts: Any) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return degrees + minutes / 60 + seconds / 3600
