"""The table and the file of a bench say the same, with every raw value beside each figure."""

import json

import pytest

from bench.results import Report, of_network, quantile


@pytest.fixture
def report():
    made = Report("sample")
    made.figure("late", [3.0, 1.0, 2.0], unit="ms", must={"p95": 5.0}, limit="paper: 500")
    made.baseline("late", [10.0, 20.0], unit="ms", of="callbacks, same run")
    return made.note("load", "5 topics")


def test_the_file_has_figures_raw_values_machine_date_and_commit(report, tmp_path):
    found = json.loads(report.write(tmp_path / "results").read_text())
    figure = found["figures"]["late"]
    assert figure["values"] == [3.0, 1.0, 2.0]
    assert {key: figure[key] for key in ("n", "p50", "max", "unit", "held")} == {
        "n": 3,
        "p50": 2.0,
        "max": 3.0,
        "unit": "ms",
        "held": True,
    }
    assert figure["p95"] == pytest.approx(2.9)
    assert found["baselines"]["late (callbacks, same run)"]["values"] == [10.0, 20.0]
    assert found["machine"]["cores"] >= 1
    assert 0 <= found["machine"]["stolen_percent"] <= 100
    assert found["date"].endswith("+00:00")
    assert found["commit"]
    assert found["notes"] == {"load": "5 topics"}


def test_the_table_shows_figures_bounds_baselines_and_notes(report):
    table = report.table()
    assert "p95 <= 5: ok, paper: 500" in table
    assert "late (callbacks, same run)" in table
    assert "load: 5 topics" in table


def test_a_missed_bound_is_reported(report):
    assert report.held
    report.figure("slow", [9.0], unit="ms", must={"max": 5.0})
    assert not report.held
    assert "max <= 5: MISSED" in report.table()
    assert report.json()["figures"]["slow"]["held"] is False


def test_a_figure_without_values_is_refused():
    with pytest.raises(ValueError, match="'late' has no values"):
        Report("sample").figure("late", [], unit="ms")


def test_an_unknown_bound_is_refused():
    with pytest.raises(ValueError, match="must bounds p99; known are n, p50"):
        Report("sample").figure("late", [1.0], unit="ms", must={"p99": 1.0})


@pytest.mark.parametrize(("fraction", "expected"), [(0, 1.0), (0.5, 2.5), (0.95, 3.85), (1, 4.0)])
def test_quantiles_lie_between_the_nearest_ranks(fraction, expected):
    assert quantile([4.0, 1.0, 3.0, 2.0], fraction) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("status", "name"),
    [
        (
            "cluster understudy: Kubernetes 1.34.4, network cilium, at https://198.18.0.1:6443 is ready",
            "recovery-cilium",
        ),
        ("cluster understudy: Kubernetes 1.34.4, network own, at https://198.18.0.1:6443 is ready", "recovery"),
        ("the cluster of KUBECONFIG", "recovery"),
    ],
)
def test_the_results_on_another_network_have_a_file_of_their_own(status, name):
    assert of_network("recovery", status) == name
