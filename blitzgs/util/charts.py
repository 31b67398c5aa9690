# SPDX-License-Identifier: Apache-2.0
"""Draws small SVG charts without a plotting package: line charts, and maps of cells."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

_COLORS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#7f7f7f")
_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM, _RIGHT = 720, 360, 70, 30, 45, 20
_NAME, _CELLS = 14, 320


def line_chart(
    lines: Mapping[str, Sequence[tuple[float, float]]], x_label: str, y_label: str, most: float | None = None
) -> str:
    """Draw lines, name -> (x, y) with x and y >= 0, over axes that begin at zero.

    The y axis ends at `most`; None: at a round number, at least the largest y.
    """
    points = [point for line in lines.values() for point in line]
    last = max((x for x, _ in points), default=0.0) or 1.0
    rows = _ticks(most or max((y for _, y in points), default=0.0) or 1.0)
    top = rows[-1]
    # The names of the lines are above the chart, one below the other.
    names = _NAME * (len(lines) - 1)
    height = _HEIGHT + names
    inner_width, inner_height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        return _LEFT + inner_width * x / last, names + _TOP + inner_height * (1 - y / top)

    parts = []
    for value in rows:
        x, y = place(0, value)
        parts.append(f'<path d="M{x:.1f} {y:.1f}H{_WIDTH - _RIGHT}" stroke="#ddd"/>')
        parts.append(_text(x - 8, y + 4, _short(value), "end"))
    for value in _ticks(last):
        if value <= last:
            parts.append(_text(place(value, 0)[0], height - _BOTTOM + 18, _short(value), "middle"))
    for k, (name, line) in enumerate(lines.items()):
        color = _COLORS[k % len(_COLORS)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*point) for point in line))
        parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        if len(lines) > 1:
            parts.append(_text(_WIDTH - _RIGHT, 18 + _NAME * k, name, "end", color))
    parts += [_text(_LEFT, names + 18, y_label), _text(_WIDTH - _RIGHT, height - 8, x_label, "end")]
    return _picture(_WIDTH, height, parts)


def maps(cells: Mapping[str, NDArray[np.float64]]) -> str:
    """Draw maps of shares in [0, 1] side by side: orange for 0, blue for 1; NaN is left white.

    They are name -> [rows, columns], the first row at the bottom.
    """
    parts = []
    for k, (name, values) in enumerate(cells.items()):
        left, (rows, columns) = k * (_CELLS + 20) + 10, values.shape
        parts.append(_text(left, 18, name))
        width, height = _CELLS / columns, _CELLS / rows
        for row, column in zip(*np.nonzero(~np.isnan(values)), strict=True):
            share = values[row, column]
            color = tuple(
                round(a + (b - a) * share) for a, b in zip((255, 127, 14), (31, 119, 180), strict=True)
            )
            x, y = left + column * width, 28 + (rows - 1 - row) * height
            parts.append(
                f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.2f}" height="{height:.2f}" fill="rgb{color}"/>'
            )
    return _picture(len(cells) * (_CELLS + 20), _CELLS + 40, parts)


def _picture(width: float, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        f'font-size="12"><rect width="{width}" height="{height}" fill="white"/>{"".join(parts)}</svg>\n'
    )


def _text(x: float, y: float, text: str, anchor: str = "start", color: str = "black") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{color}">{escape(text)}</text>'


def _ticks(largest: float) -> list[float]:
    """Return the multiples of a round number, at most six, from zero to the first that is >= `largest`."""
    size = 10.0 ** math.floor(math.log10(largest / 5))
    step = next(factor * size for factor in (1, 2, 2.5, 5, 10) if 5 * factor * size >= largest)
    return [step * k for k in range(math.ceil(largest / step) + 1)]


def _short(value: float) -> str:
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"
