"""The pure parts of scripts/bench scale: what was counted, who fails when, what a fleet is, and how figures grow."""

import random
from itertools import pairwise

import pytest
import yaml

from bench import scale
from bench.scaling import counting
from bench.scaling.arrivals import poisson, spread
from bench.scaling.exposition import Reading, read
from bench.scaling.fleets import fleets, shared, workload
from bench.scaling.growth import exponent, extrapolated
from understudy.cli.check.command import check

TEXT = """
# HELP apiserver_watch_events_total Number of events sent in watch clients
# TYPE apiserver_watch_events_total counter
apiserver_watch_events_total{group="",resource="pods",version="v1"} 40
apiserver_watch_events_total{group="apps",resource="deployments",version="v1"} 2
process_cpu_seconds_total 1.5e+01
apiserver_flowcontrol_dispatched_requests_total{flow_schema="bench-monitor-claims",priority_level="workload-low"} 7
apiserver_flowcontrol_dispatched_requests_total{flow_schema="bench-operator-leases",priority_level="workload-low"} 3
another{said="a \\"quoted\\", word"} 1
"""


def counted(**more: float) -> Reading:
    names = [*counting.NAMES, "another"]
    lines = [f'{counting.DISPATCHED}{{flow_schema="bench-{name}"}} {value}' for name, value in more.items()]
    return read("\n".join([TEXT, *lines]), names)


# -- counting ------------------------------------------------------------------------------------------------------------


def test_samples_are_summed_by_label():
    found = counted()
    assert found.total(counting.EVENTS) == 42
    assert found.total(counting.EVENTS, resource="pods") == 40
    assert found.total(counting.EVENTS, resource=("pods", "deployments")) == 42
    assert found.total(counting.CPU) == 15.0
    assert found.by(counting.EVENTS, "resource") == {"pods": 40, "deployments": 2}
    assert found.total("another", said='a \\"quoted\\", word') == 1


def test_only_requested_metrics_are_read():
    assert read(TEXT, {counting.CPU}).samples == {(counting.CPU, ()): 15.0}


def test_a_counter_that_restarted_counts_from_zero():
    before = Reading({("a", ()): 5.0, ("b", ()): 9.0})
    now = Reading({("a", ()): 7.0, ("b", ()): 2.0, ("c", ()): 1.0})
    assert now.since(before).samples == {("a", ()): 2.0, ("b", ()): 2.0, ("c", ()): 1.0}


def test_every_kind_of_write_has_its_own_flow_schema():
    made = {schema["metadata"]["name"]: schema["spec"] for schema in counting.schemas(["fleet-0", "fleet-1"], "system")}
    for who, kinds in (("monitor", counting.MONITOR), ("operator", counting.OPERATOR)):
        for kind in [*kinds, "other"]:
            name = f"{who}-{kind.replace(' ', '-')}"
            assert f"bench-{name}" in made
            if kind != "leases":
                assert counting.writes(counted(**{name: 5.0}), who)[kind] >= 5
            precedences = [
                made[f"bench-{who}-{other}"]["matchingPrecedence"] for other in (kind.replace(" ", "-"), "other")
            ]
            assert precedences[0] < precedences[1] or kind == "other", "what is left is looked at last"


def test_leases_and_dry_runs_are_not_writes():
    line = f'{counting.REQUESTS}{{dry_run="All",resource="pods",verb="POST"}} 4'
    found = read(
        "\n".join([TEXT, line, f'{counting.DISPATCHED}{{flow_schema="bench-operator-pods"}} 5']), counting.NAMES
    )
    assert counting.writes(found, "operator") == {"pods": 1}
    assert counting.writes(found, "monitor") == {"claims": 7}


def test_flow_schemas_distinguish_monitors_from_the_operator():
    groups = {
        schema["metadata"]["name"].split("-")[1]: {
            subject["group"]["name"] for rule in schema["spec"]["rules"] for subject in rule["subjects"]
        }
        for schema in counting.schemas(["fleet-0", "fleet-1"], "system")
    }
    assert groups == {
        "monitor": {"system:serviceaccounts:fleet-0", "system:serviceaccounts:fleet-1"},
        "operator": {"system:serviceaccounts:system"},
    }


# -- arrivals ------------------------------------------------------------------------------------------------------------


def test_arrivals_follow_a_poisson_process():
    times = poisson(100.0, 200.0, random.Random(7))
    assert times == sorted(times)
    assert 0 < times[0] < times[-1] < 200
    assert len(times) == pytest.approx(20_000, rel=0.03)
    gaps = [b - a for a, b in pairwise(times)]
    mean = sum(gaps) / len(gaps)
    deviation = (sum((gap - mean) ** 2 for gap in gaps) / len(gaps)) ** 0.5
    assert deviation == pytest.approx(mean, rel=0.05)


def test_a_robot_fails_again_only_after_all_others():
    found = spread(range(10), 25, random.Random(7))
    assert sorted(found[:10]) == sorted(found[10:20]) == list(range(10))
    assert len(set(found[20:])) == 5


# -- fleets --------------------------------------------------------------------------------------------------------------


def test_robots_are_divided_into_fleets_and_the_last_may_be_smaller():
    found = fleets(25, 10)
    assert [len(fleet.robots) for fleet in found] == [10, 10, 5]
    assert len({robot.key for fleet in found for robot in fleet.robots}) == 25
    assert all(robot.namespace == fleet.namespace for fleet in found for robot in fleet.robots)


def test_generated_manifests_pass_the_check():
    items = [*shared(7), workload(fleets(1, 1)[0].robots[0])]
    found = check([("bench", yaml.safe_dump_all(items).encode())])
    assert found.checked == 3
    assert not found.errors, found.findings


@pytest.mark.parametrize(
    ("robots", "fleet", "expected"),
    [(1000, 100, [100, 300, 1000]), (20, 10, [10, 20]), (1000, 1000, [1000]), (50, 50, [50]), (250, 100, [100, 250])],
)
def test_sizes_are_whole_fleets(robots: int, fleet: int, expected: list[int]):
    assert scale.sizes(robots, fleet) == expected


# -- claims --------------------------------------------------------------------------------------------------------------


def pod(uid: str, claim: str) -> dict[str, object]:
    return {"metadata": {"uid": uid, "annotations": {scale.cluster.names.CLAIM: claim}}}


def test_acknowledged_claims_are_neither_double_nor_lost():
    assert scale.exclusive([("1", "a"), ("2", "b")], [pod("1", "a"), pod("2", "b")]) == (0, 0)


@pytest.mark.parametrize(
    ("acknowledged", "pods", "double", "lost"),
    [
        ([("1", "a"), ("1", "b")], [pod("1", "b")], 1, 0),
        ([("1", "a")], [pod("1", "a"), pod("2", "a")], 1, 1),
        ([("1", "a")], [pod("1", "b")], 0, 1),
        ([("1", "a")], [], 0, 1),
        ([], [pod("1", "a")], 0, 1),
    ],
)
def test_double_and_lost_claims_are_counted(acknowledged, pods, double, lost):
    assert scale.exclusive(acknowledged, pods) == (double, lost)


# -- growth --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_the_exponent_of_a_power_law_is_fitted(power: float):
    sizes = [100.0, 300.0, 1000.0]
    assert exponent(sizes, [3 * size**power for size in sizes]) == pytest.approx(power)


def test_zero_values_have_no_exponent():
    assert exponent([100, 1000], [0.0, 5.0]) is None
    assert exponent([100], [5.0]) is None


def test_proportional_growth_is_extrapolated_proportionally():
    assert extrapolated([100, 300, 1000], [10, 30, 100], 10_000) == pytest.approx((1000, 1000))


def test_growth_with_a_fixed_part_is_between_the_power_law_and_the_line():
    least, most = extrapolated([100, 1000], [100 + 100, 100 + 1000], 10_000)
    assert least < 100 + 10_000 == pytest.approx(most)


def test_a_decreasing_figure_is_not_extrapolated():
    assert extrapolated([100, 1000], [20, 10], 10_000) == (10, 10)
