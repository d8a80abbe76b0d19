"""What is printed in a terminal that is narrower than it."""

from __future__ import annotations

import pytest

from understudy.cli.common.text.wording import wrap_labelled
from understudy.cli.plan.size import main

PAPER = ["--robots", "1000", "--failures-per-robot-hour", "1", "--recovery-seconds", "6"]


def test_text_is_unchanged_without_a_width():
    assert wrap_labelled("asked for  " + "word " * 40, None) == "asked for  " + "word " * 40


def test_a_long_line_continues_below_the_text_after_its_label():
    assert wrap_labelled("asked for  a recovery within two seconds of it\nnext", 30) == (
        "asked for  a recovery within\n           two seconds of it\nnext"
    )
    assert (
        wrap_labelled("1.  Initialized (warm)  830 ms  the cheapest", 32)
        == "1.  Initialized (warm)  830 ms\n    the cheapest"
    )
    assert wrap_labelled("plain words that are too long", 20) == "plain words that are\ntoo long"


def test_a_row_without_a_label_stays_in_one_piece():
    row = "window: more than 4 failures within 6 s          2.75 %     2.71 %"
    assert wrap_labelled(row, 40) == row


def test_everything_except_the_table_fits_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*PAPER, "--fallbacks", "4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("           simulated") for line in lines)
    assert all(
        len(line) <= 80
        for line in lines
        if " %   " not in line and "BY TRIAL" not in line and "  " not in line.strip()[12:]
    )
