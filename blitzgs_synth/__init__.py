# SPDX-License-Identifier: Apache-2.0
"""A procedural city, photographed from the air: a capture of any size with known geometry.

Streets, houses, trees and cars are laid out by rules from a seed (`plan`, `city`, `buildings`),
painted by procedural materials (`materials`, `ground`), photographed with Embree rays along flight lines
(`render`, `flight`), and written with the sparse model that a structure-from-motion tool would give
(`tracks`, `generate`).
"""

from blitzgs_synth.generate import generate_city
from blitzgs_synth.plan import PRESETS, CityOptions

__all__ = ["PRESETS", "CityOptions", "generate_city"]
