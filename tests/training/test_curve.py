# SPDX-License-Identifier: Apache-2.0
"""A fall of the training PSNR is reported once, with its size and place."""

from blitzgs.training.curve import FALL, WINDOW, Curve


def followed(values, curve=None):
    curve = Curve() if curve is None else curve
    return curve, [text for i, value in enumerate(values) if (text := curve.add(100 * (i + 1), value))]


def test_a_fall_is_reported_once():
    values = [20.0] * WINDOW + [25.0] * WINDOW + [25.0 - FALL - 1] * (2 * WINDOW)
    curve, said = followed(values)
    assert len(said) == 1 and "3." in said[0] and "25.0 dB" in said[0]
    assert curve.fall == FALL + 1 and len(curve.warnings()) == 1


def test_single_batches_are_no_fall():
    curve, said = followed(([25.0] * (WINDOW - 1) + [15.0]) * 4)
    assert not said and not curve.warnings()


def test_a_reset_begins_anew():
    curve, _ = followed([25.0] * WINDOW)
    curve.restart()
    curve, said = followed([15.0] * (2 * WINDOW), curve)
    assert not said and curve.fall == 0


def test_survives_a_resume():
    curve, _ = followed([25.0] * 20)
    again = Curve.of(curve.saved())
    assert again == curve and followed([19.0] * 30, again)[1]
