# SPDX-License-Identifier: Apache-2.0
import pytest

from blitzgs.util.terminal import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, ünïcode 🏙\n\tand more", "plain, ünïcode 🏙\n\tand more"),
        ("a\x1b[31mred", "a\\x1b[31mred"),
        ("\x07\x00\x7f\r", "\\x07\\x00\\x7f\\r"),
        ("\x9b2J", "\\x9b2J"),
        ("gpj.\u202e", "gpj.\\u202e"),
    ],
)
def test_control_characters_are_escaped(text, shown):
    assert printable(text) == shown
