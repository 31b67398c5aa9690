# SPDX-License-Identifier: Apache-2.0
import time

import psutil
import pytest

from blitzgs.util.progress import Laps


def test_parts_add_up_from_the_start_of_the_process(monkeypatch):
    begin = psutil.Process().create_time()
    laps = Laps(since_start=True)
    for seconds, name in ((2, "imports"), (5, "capture"), (4, "clock set back"), (6.5, "capture")):
        monkeypatch.setattr(time, "time", lambda at=begin + seconds: at)
        laps.lap(name)
    assert laps.seconds == pytest.approx({"imports": 2, "capture": 5.5, "clock set back": 0})
    assert laps.text() == "set-up 7.5 s: imports 2.0, capture 5.5, clock set back 0.0"
