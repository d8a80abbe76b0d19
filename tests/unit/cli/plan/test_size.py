"""``understudy size``: what it prints, and what it says to what it can't answer."""

import itertools
import json

import pytest
import yaml

from tests.support.golden import assert_golden
from understudy.cli.plan.size import main

PAPER = ["--robots", "1000", "--failures-per-robot-hour", "1", "--recovery-seconds", "6"]


def printed(capsys, *more):
    assert main([*PAPER, *more]) == 0
    return capsys.readouterr().out


def test_the_example_of_the_paper_is_printed_with_its_figures_and_limits(capsys):
    text = printed(capsys, "--fallbacks", "4")
    certain = [line for line in text.splitlines() if "±" not in line]
    assert_golden("plan", certain, "1000 robots", "3.6 s", "8.3", "30 s", "3276", "278256", "1.18 %", "0.40%")
    assert "more than 4 fail within 6 s" in text
    assert "6.24 %" in next(line for line in text.splitlines() if line.startswith("loss"))


@pytest.mark.parametrize(
    "more",
    [
        ["--fallbacks", "0"],
        ["--fallbacks", "4"],
        ["--risk", "0.01"],
        ["--risk", "0.01", "--risk-of", "window"],
        ["--fallbacks", "9", "--refill-seconds", "6.12345"],  # waits whose figures are long
        ["--risk", "0.000001"],
        ["--risk", "0.01", "--robots", "100000", "--refill-seconds", "3600.25"],
    ],
)
def test_no_line_is_broken_by_a_terminal_of_80_columns(capsys, monkeypatch, more):
    monkeypatch.setenv("COLUMNS", "80")
    lines = printed(capsys, *more).splitlines()
    assert [line for line in lines if len(line) > 80] == []
    assert sum(line.startswith(("window: ", "loss: ", "waiting: ", "mean wait ")) for line in lines) == 4


def test_json_output_contains_all_figures(capsys):
    found = json.loads(printed(capsys, "--fallbacks", "4", "-o", "json"))
    assert found["outcome"]["cpu"] == pytest.approx(0.004)
    assert found["outcome"]["loss"] == pytest.approx(found["trial"]["loss"]["mean"], abs=0.01)
    assert found["outcome"]["down"] == pytest.approx(6 + found["outcome"]["loss"] * 6)
    assert found["paper"]["chance"] == pytest.approx(3276 / 278256)
    assert found["downTimeGainedPerRobotHour"] == pytest.approx(12 - found["outcome"]["down"])


def test_endless_waiting_is_null_in_json_and_explained_in_text(capsys):
    found = json.loads(printed(capsys, "--fallbacks", "1", "-o", "json"))
    assert (found["outcome"]["waiting"], found["outcome"]["wait"]) == (1, None)
    assert "unbounded" in printed(capsys, "--fallbacks", "1")
    assert json.loads(printed(capsys, "--fallbacks", "0", "-o", "json"))["trial"]["wait"]["mean"] is None


def test_yaml_output_equals_json_output(capsys):
    for arguments in (["--fallbacks", "1"], ["--risk", "0.01"]):
        written = yaml.safe_load(printed(capsys, *arguments, "-o", "yaml"))
        assert written == json.loads(printed(capsys, *arguments, "-o", "json"))


@pytest.mark.parametrize(
    ("rate", "seconds"), list(itertools.product(("1e-9", "1e9"), repeat=2)), ids=lambda value: value
)
def test_extreme_figures_give_a_result(capsys, rate, seconds):
    figures = ["--robots", "1", "--failures-per-robot-hour", rate, "--recovery-seconds", seconds, "--fallbacks", "1"]
    assert main(figures) == 0
    assert "loss: a failure finds no fallback" in capsys.readouterr().out


def test_a_risk_gives_the_size_by_each_measure(capsys):
    found = json.loads(printed(capsys, "--risk", "0.01", "-o", "json"))
    assert found["outcome"]["fallbacks"] == found["needed"]["loss"]
    assert found["outcome"]["loss"] <= 0.01
    assert found["needed"]["window"] <= found["needed"]["loss"] <= found["needed"]["waiting"]
    by_waiting = json.loads(printed(capsys, "--risk", "0.01", "--risk-of", "waiting", "-o", "json"))
    assert by_waiting["outcome"]["fallbacks"] == by_waiting["needed"]["waiting"]
    assert "for a risk of 1 % (waiting; " in printed(capsys, "--risk", "0.01", "--risk-of", "waiting")


def test_a_risk_is_printed_as_the_sizing_of_a_pool(capsys):
    sizing = "spec.sizing: {risk: 1%, riskOf: Loss, failuresPerRobotHour: 1, refill: 6s, max: 12}"
    assert sizing in printed(capsys, "--risk", "0.01")
    assert "spec.sizing" not in printed(capsys, "--risk", "0.01", "--risk-of", "window")
    assert "spec.sizing" not in printed(capsys, "--fallbacks", "4")


def test_fallback_resources_and_refill_time_change_the_result(capsys):
    slow = json.loads(
        printed(capsys, "--fallbacks", "4", "--fallback-cpu", "0.6", "--refill-seconds", "12", "-o", "json")
    )
    quick = json.loads(printed(capsys, "--fallbacks", "4", "-o", "json"))
    assert slow["outcome"]["cpu"] == pytest.approx(0.0024)
    assert slow["outcome"]["loss"] > quick["outcome"]["loss"]


def test_duration_options_equal_the_options_in_seconds(capsys):
    numbers = ["--recovery-seconds", "0.5", "--refill-seconds", "90", "--restart-seconds", "12"]
    durations = ["--recovery", "500ms", "--refill", "1m30s", "--restart", "12s"]
    plain, same = (printed(capsys, "--fallbacks", "4", *arguments, "-o", "json") for arguments in (numbers, durations))
    assert same == plain
    assert json.loads(plain)["outcome"]["down"] < 12


def test_figures_can_be_given_in_the_format_of_pool_sizing(capsys):
    assert main([*PAPER, "--risk", "0.01", "--fallback-cpu", "0.4", "--refill-seconds", "90", "-o", "json"]) == 0
    plain = capsys.readouterr().out
    assert main([*PAPER, "--risk", "1%", "--fallback-cpu", "40%", "--refill-seconds", "1m30s", "-o", "json"]) == 0
    assert capsys.readouterr().out == plain


@pytest.mark.parametrize("form", ["png", "svg"])
def test_the_plot_is_drawn(capsys, tmp_path, form):
    pytest.importorskip("matplotlib")
    file = tmp_path / f"size.{form}"
    printed(capsys, "--risk", "0.01", "--plot", str(file))
    assert file.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--fallbacks", "-1"], "--fallbacks: found '-1'; give a whole number from 0 to 1000000"),
        (["--fallbacks", "few"], "--fallbacks: found 'few'"),
        (["--risk", "0"], "--risk: found '0'; give a probability, above 0"),
        (["--risk", "2"], "--risk: found '2'"),
        (["--fallbacks", "4", "--risk", "0.1"], "not allowed with argument"),
        ([], "one of the arguments --fallbacks --risk is required"),
        (["--fallbacks", "4", "--robots", "0"], "--robots: found '0'"),
        (["--fallbacks", "4", "--recovery-seconds", "nan"], "--recovery: found 'nan'; give a duration above 0"),
        (
            ["--fallbacks", "4", "--recovery-seconds", "6x"],
            "argument --recovery-seconds/--recovery: found '6x'; give a duration above 0, such as 500ms",
        ),
        (["--fallbacks", "4", "--recovery-seconds", "0s"], "--recovery: found '0s'"),
        (
            ["--fallbacks", "4", "--recovery", "1e-300"],
            "found '1e-300'; give a duration, such as 500ms or 6s, from 1e-09",
        ),
        (["--fallbacks", "4", "--failures-per-robot-hour", "1e300"], "such as 0.2, from 1e-09 to 1e+09"),
        (["--fallbacks", "4", "--fallback-cpu", "-1"], "--fallback-cpu: found '-1'; give a share of at least 0"),
        (["--risk", "0%"], "--risk: found '0%'; give a probability, above 0"),
        (["--risk", "%"], "--risk: found '%'"),
    ],
)
def test_inconsistent_options_are_refused_by_name(capsys, more, expected):
    with pytest.raises(SystemExit) as ended:
        main([*PAPER, *more])
    assert ended.value.code == 2
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--fallbacks", "4", "--plot", "size.txt"], "--plot: found 'size.txt'; its name must end in .png"),
        (["--fallbacks", "4", "--plot", "/nowhere/size.png"], "--plot: the folder /nowhere does not exist"),
        (["--risk", "0.01", "--refill-seconds", "1e9"], "--risk: a pool of 1000000 is not enough"),
    ],
)
def test_impossible_requests_are_reported_with_a_solution(capsys, more, expected):
    assert main([*PAPER, *more]) == 2
    error = capsys.readouterr().err
    assert error.startswith("understudy size: ")
    assert expected in error
