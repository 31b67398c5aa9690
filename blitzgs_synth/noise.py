# SPDX-License-Identifier: Apache-2.0
"""Procedural pattern primitives: smooth noise, per-cell random numbers and box-filtered stripes.

All take the sampling footprint into account (metres covered by one sample), because a pattern finer than
its sampling would flicker from view to view instead of averaging out.
"""

from __future__ import annotations

import cv2
import numpy as np

from blitzgs_synth.arrays import Floats

_LATTICE = 64  # random values along one period of the noise
_TEXELS = 8  # texels from one random value to the next
_ROW = 4096  # cv2.remap wants two-dimensional maps with short sides


class Noise:
    """Smooth tileable noise with one bump per unit length, mean 0 and standard deviation 1."""

    def __init__(self, seed: int) -> None:
        lattice = np.random.default_rng(seed).standard_normal((_LATTICE, _LATTICE)).astype(np.float32)
        border = 2
        padded = np.pad(lattice, border, mode="wrap")
        texture = cv2.resize(padded, None, fx=_TEXELS, fy=_TEXELS, interpolation=cv2.INTER_CUBIC)
        cut = border * _TEXELS
        texture = texture[cut:-cut, cut:-cut]
        texture = (texture - texture.mean()) / texture.std()
        # One more row and column, so that interpolation at the seam needs no wrapping.
        self._texture = np.ascontiguousarray(np.pad(texture, (0, 1), mode="wrap"))

    def __call__(self, x: Floats, y: Floats) -> Floats:
        """Return the noise at positions x, y [R] in units of its wavelength."""
        count = len(x)
        if count == 0:  # cv2 has no empty images
            return np.zeros(0, np.float32)
        rows = -(-count // _ROW)
        maps = np.zeros((2, rows * _ROW), np.float32)
        for plane, coordinate in zip(maps, (x, y), strict=True):
            periods = np.multiply(coordinate, np.float32(1 / _LATTICE), out=plane[:count])
            periods -= np.floor(periods)
            periods *= np.float32(_LATTICE * _TEXELS)
        u, v = maps.reshape(2, rows, _ROW)
        sampled = cv2.remap(self._texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values: Floats = sampled.reshape(-1)[:count]
        return values

    def layers(self, x: Floats, y: Floats, footprint: Floats, *bands: tuple[float, float]) -> Floats:
        """Return a sum of bands (wavelength in metres, amplitude), each faded out where it is unresolved."""
        total = np.zeros_like(x)
        for index, (wavelength, amplitude) in enumerate(bands):
            # Each band is turned by another angle, so that their lattices do not line up.
            c, s = np.cos(0.6 + 1.9 * index) / wavelength, np.sin(0.6 + 1.9 * index) / wavelength
            band = self(np.float32(c) * x - np.float32(s) * y, np.float32(s) * x + np.float32(c) * y)
            total += np.float32(amplitude) * resolved(wavelength, footprint) * band
        return total


def resolved(size: float, footprint: Floats) -> Floats:
    """Return the share of a pattern of that size (metres) that survives sampling: 0 to 1, [R]."""
    return np.clip(np.float32(1.6) - np.float32(1.6 / size) * footprint, 0, 1)


def cell_random(ix: Floats, iy: Floats, salt: Floats | int) -> Floats:
    """Return one uniform number in [0, 1) per integer cell (ix, iy) and salt, [R]."""
    h = ix.astype(np.int32).view(np.uint32) * np.uint32(0x9E3779B1)
    h ^= iy.astype(np.int32).view(np.uint32) * np.uint32(0x85EBCA77)
    extra = np.asarray(salt, dtype=np.float32).astype(np.int32).view(np.uint32)
    h ^= extra * np.uint32(0xC2B2AE3D)
    h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(12)
    h *= np.uint32(0x297A2D39)
    h ^= h >> np.uint32(15)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def stripes(
    x: Floats, period: float | Floats, low: float | Floats, high: float | Floats, footprint: Floats
) -> Floats:
    """Return the coverage of the stripes low <= frac(x / period) < high, box-filtered, [R]."""
    scaled = (x / period).astype(np.float32)
    half = np.maximum(footprint / period, 1e-3).astype(np.float32) * np.float32(0.5)

    def integral(t: Floats) -> Floats:
        whole = np.floor(t)
        filled: Floats = whole * (high - low) + np.clip(t - whole - low, 0, high - low)
        return filled

    covered: Floats = (integral(scaled + half) - integral(scaled - half)) / (2 * half)
    return covered.astype(np.float32)


def inside(x: Floats, low: float | Floats, high: float | Floats, footprint: Floats) -> Floats:
    """Return the coverage of the interval low <= x <= high by a sample of that footprint, [R]."""
    width = np.maximum(footprint, 1e-3)
    begin = np.maximum(x - width / 2, low)
    end = np.minimum(x + width / 2, high)
    return np.clip((end - begin) / width, 0, 1).astype(np.float32)
