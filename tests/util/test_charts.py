# SPDX-License-Identifier: Apache-2.0
"""The labels of charts are round numbers at their own places."""

import re
from xml.etree import ElementTree

import pytest

from blitzgs.util.charts import line_chart

NAMESPACE = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize(
    ("points", "most", "columns", "rows"),
    [
        (
            [(0, 1547), (750, 10411)],
            None,
            ["0", "200", "400", "600"],
            ["0", "2.5k", "5k", "7.5k", "10k", "12.5k"],
        ),
        (
            [(0, 3), (30_000, 1e6)],
            None,
            ["0", "10k", "20k", "30k"],
            ["0", "200k", "400k", "600k", "800k", "1M"],
        ),
        ([(5, 0.5)], 1.0, ["0", "1", "2", "3", "4", "5"], ["0", "0.2", "0.4", "0.6", "0.8", "1"]),
        ([(0, 0)], None, ["0", "0.2", "0.4", "0.6", "0.8", "1"], ["0", "0.2", "0.4", "0.6", "0.8", "1"]),
    ],
)
def test_axes_have_round_numbers(points, most, columns, rows):
    chart = ElementTree.fromstring(line_chart({"": points}, "images", "Gaussians", most))
    labels = list(chart.iter(f"{NAMESPACE}text"))
    assert [label.text for label in labels if label.get("text-anchor") == "middle"] == columns
    below = [label for label in labels if label.get("text-anchor") == "end" and label.text != "images"]
    assert [label.text for label in below] == rows


def test_a_label_is_below_its_point():
    chart = line_chart({"": [(0, 1), (600, 2), (750, 3)]}, "images", "Gaussians")
    (line,) = re.findall(r'polyline points="([^"]*)"', chart)
    x = line.split()[1].split(",")[0]
    assert f'<text x="{x}" y="333.0" text-anchor="middle" fill="black">600</text>' in chart


def test_names_of_lines_are_above_the_chart():
    names = ("one", "two", "three")
    chart = ElementTree.fromstring(line_chart({name: [(0, 0), (1, 1)] for name in names}, "x", "y"))
    labels = {label.text: float(label.get("y")) for label in chart.iter(f"{NAMESPACE}text")}
    top = float(chart.find(f"{NAMESPACE}polyline").get("points").split()[1].split(",")[1])
    assert labels["one"] < labels["two"] < labels["three"] < top
    assert float(chart.get("viewBox").split()[3]) == 360 + 2 * 14
