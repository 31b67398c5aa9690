# SPDX-License-Identifier: Apache-2.0
from blitzgs.util.progress import image_progress


def count(shown):
    with image_progress("Counting", shown) as report:
        for done in range(1, 4):
            report(done, 3)


def test_a_terminal_shows_how_far_the_work_is(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    count(True)
    shown = capsys.readouterr()
    assert "Counting" in shown.err and "3/3" in shown.err and not shown.out
    count(False)
    assert not capsys.readouterr().err


def test_a_file_gets_no_bar(capsys, monkeypatch):
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    count(True)
    assert not capsys.readouterr().err
