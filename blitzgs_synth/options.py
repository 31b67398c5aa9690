# SPDX-License-Identifier: Apache-2.0
"""The parameters of a city, and the presets of the command line."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

# Raised whenever the same parameters would give other files, so that cached cities are made anew.
FORMAT_VERSION = 3
# Fields that the first cities of this version did not have.
_LATER = ("built", "grain", "exposure", "altitudes")


@dataclass(frozen=True)
class CityOptions:
    """Parameters of a synthetic city; the same values give the same files.

    Attributes:
        extent: edge of the built-up square in metres, 60 to 20 000.
        views: number of images, >= 3.
        width: image width in pixels, >= 32.
        height: image height in pixels, >= 32.
        points_per_view: feature points looked for in each image; the cloud has somewhat fewer in total.
        oblique: fraction of the views flown obliquely (45°, four headings); the others look straight down.
        seed: of the layout, the buildings, the flight and the noise.
        built: whether there is a city; false: flat farmland of finely textured crops.
        grain: standard deviation of the noise of the photographs, in steps of 8-bit values.
        exposure: standard deviation of the logarithm of the photographs' gains.
        altitudes: number of heights flown at, 1 to 8; each is 1.6 times the one below it and has, for the
            same overlap, 1 / 1.6² of its views.
    """

    extent: float = 150.0
    views: int = 60
    width: int = 480
    height: int = 320
    points_per_view: int = 500
    oblique: float = 0.6
    seed: int = 0
    built: bool = True
    grain: float = 0.0
    exposure: float = 0.0
    altitudes: int = 1

    def __post_init__(self) -> None:
        limits = {
            "extent": (60.0, 20_000.0),
            "views": (3, 1_000_000),
            "width": (32, 16_384),
            "height": (32, 16_384),
            "points_per_view": (1, 100_000),
            "oblique": (0.0, 1.0),
            "seed": (0, 2**63 - 1),
            "built": (False, True),
            "grain": (0.0, 64.0),
            "exposure": (0.0, 1.0),
            "altitudes": (1, 8),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"synthetic city: {name} must be between {low} and {high}, got {value}")

    def manifest(self) -> dict[str, float | int]:
        """Return the parameters that decide the files' content, for a city's manifest.

        Those added later are left out where they change nothing, so that older cities need not be made anew.
        """
        values = asdict(self)
        same = [
            field.name
            for field in fields(self)
            if field.name in _LATER and values[field.name] == field.default
        ]
        return {"format_version": FORMAT_VERSION, **{k: v for k, v in values.items() if k not in same}}


PRESETS = {
    # Takes well under a minute on two cores; the default scene of `make demo`.
    "demo": CityOptions(),
    # A quarter of a square kilometre in as many views as an aerial survey would take.
    "town": CityOptions(extent=500.0, views=400, width=1368, height=912, points_per_view=1000),
    # More than two square kilometres, with the views and the image size of the usual large captures.
    "city": CityOptions(extent=1600.0, views=2048, width=1368, height=912, points_per_view=1200),
    # Four square kilometres from three heights.
    "metropolis": CityOptions(
        extent=2000.0, views=5120, width=1368, height=912, points_per_view=1200, altitudes=3
    ),
    # Flat crops from straight above, with grain: a capture on which training can lose what it has learnt
    # (docs/decisions.md).
    "farmland": CityOptions(
        extent=600.0,
        views=166,
        width=800,
        height=600,
        points_per_view=450,
        oblique=0.0,
        built=False,
        grain=5.0,
    ),
}
