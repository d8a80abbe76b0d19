"""Mean CPU per pod: only what was used in the run counts, restarts and late comers included."""

from __future__ import annotations

import pytest

from bench.cpu import Container, Sampler, Usage


def line(pod: str, seconds: float, at: float, container: str = "app") -> str:
    labels = f'container="{container}",namespace="fleet",pod="{pod}"'
    return f"container_cpu_usage_seconds_total{{{labels}}} {seconds:e} {int(at * 1000)}\n"


def by_pod(container: Container) -> str | None:
    return container.pod


def test_cpu_time_before_the_run_does_not_count() -> None:
    usage = Usage()
    usage.read(line("a", 50.0, 100.0), first=True)
    usage.read(line("a", 51.0, 110.0))
    assert usage.milli(by_pod) == pytest.approx({"a": 100.0})


def test_a_pod_that_starts_during_the_run_counts_over_the_whole_run() -> None:
    usage = Usage()
    usage.read(line("a", 5.0, 100.0), first=True)
    usage.read(line("a", 5.0, 105.0) + line("b", 0.5, 105.0))
    usage.read(line("a", 5.0, 110.0) + line("b", 1.0, 110.0))
    assert usage.milli(by_pod) == pytest.approx({"a": 0.0, "b": 100.0})


def test_a_restarted_container_counts_from_zero() -> None:
    usage = Usage()
    usage.read(line("a", 9.0, 100.0), first=True)
    usage.read(line("a", 10.0, 105.0))
    usage.read(line("a", 0.5, 110.0))
    assert usage.milli(by_pod) == pytest.approx({"a": 150.0})


def test_containers_are_summed_by_group_and_others_are_omitted() -> None:
    usage = Usage()
    usage.read(line("a", 0.0, 100.0) + line("a", 0.0, 100.0, "side") + line("z", 0.0, 100.0), first=True)
    usage.read(line("a", 1.0, 110.0) + line("a", 2.0, 110.0, "side") + line("z", 9.0, 110.0))
    assert usage.milli(lambda c: "robot" if c.pod == "a" else None) == pytest.approx({"robot": 300.0})


def test_an_unavailable_node_is_omitted_from_a_reading() -> None:
    readings = {"one": iter([line("a", 0.0, 100.0), line("a", 1.0, 110.0)])}

    def fetch(node: str) -> str:
        if node == "two":
            raise RuntimeError("no route")
        return next(readings[node])

    with Sampler(["one", "two"], fetch, period=60) as sampler:
        pass
    assert sampler.usage.milli(by_pod) == pytest.approx({"a": 100.0})
