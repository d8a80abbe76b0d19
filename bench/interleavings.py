"""Checks that claims, gates and pools keep their guarantees for any order of requests, answers, watches, failures and
deaths.

    scripts/bench interleavings [RUNS] [--first SEED] [--only KIND] [--processes N]
    scripts/bench interleavings --seed SEED

Each run executes the real code of monitors and operator over a modelled API server, network and cluster, in virtual
time (tests/unit/interleavings). The seed determines everything in a run. For every three runs there is one more with
a reflex, in which the robots' readers are modelled too, one more with tasks, in which clients send goals to action
proxies, and one more with a mux at each robot; their seeds start at 1,000,000, 2,000,000 and 3,000,000. With --seed only
that run is made, and everything that happened is printed.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field

from bench.results import Report
from tests.unit.interleavings import muxes, reflexes, simulation, tasks
from tests.unit.interleavings.scenes import Outcome

CHUNK = 100
"""Runs whose figures are added together."""

SHOWN = 10
"""Number of failed runs that are listed."""

PROGRESS = 10
"""Chunks after which the number of runs so far is printed."""

SHARE = 3
"""Number of runs without a reflex, tasks and a mux per run with one of them."""

KINDS = {"reflex": reflexes, "tasks": tasks, "mux": muxes}
"""The modules of the runs that have their own seeds, in the order of these."""

UNANSWERED = ("lost", "unanswered", "unheard", "late", "gateway")
"""The fates of requests after which the sender does not know whether they were carried out."""


@dataclass
class Chunk:
    """The figures of some runs."""

    runs: int = 0
    faults: dict[int, str] = field(default_factory=dict)
    """By seed."""
    counts: Counter[str] = field(default_factory=Counter)
    processor: float = 0.0
    kind: str = ""
    """``reflex``, ``tasks`` or ``mux``; empty for runs without them."""


def kind(seed: int) -> str:
    """Return the kind of a seed's run."""
    return next((name for name, of in reversed(KINDS.items()) if seed >= of.FIRST), "")


def run(seed: int, *, tracing: bool = False) -> Outcome:
    """Make the run of a seed."""
    return (KINDS[kind(seed)] if kind(seed) else simulation).run(seed, tracing=tracing)


def chunk(seeds: range) -> Chunk:
    """Make the runs of some seeds."""
    found, begun = Chunk(len(seeds), kind=kind(seeds.start)), time.process_time()
    for seed in seeds:
        outcome = run(seed)
        if outcome.faults:
            found.faults[seed] = outcome.faults[0]
        found.counts += Counter(outcome.requests) + Counter(outcome.reflex) + Counter(outcome.tasks)
        found.counts += Counter(outcome.muxes)
        found.counts += Counter(
            steps=outcome.steps,
            claims=outcome.claims,
            commits=outcome.commits,
            creations=outcome.creations,
            seconds=round(outcome.seconds),
        )
    found.processor = time.process_time() - begun
    return found


def told(chunks: Sequence[Chunk], only: str | None = None) -> Report:
    """Return the report on all runs, or on those of one kind."""
    report = Report(f"interleavings-{only}" if only else "interleavings")
    reflexive, tasked, muxed = ([c for c in chunks if c.kind == kind] for kind in KINDS)

    def counted(name: str, *outcomes: str, unit: str, of: Sequence[Chunk] = chunks) -> None:
        report.figure(name, [sum(c.counts[o] for o in outcomes) / c.runs for c in of], unit=unit)

    report.figure("runs in which something didn't hold", [len(c.faults) for c in chunks], unit="", must={"max": 0})
    counted("steps of a process", "steps", unit="per run")
    counted("claims", "claims", unit="per run")
    counted("commits to gates", "commits", unit="per run")
    counted("pods made for pools", "creations", unit="per run")
    counted("conflicts", "conflict", unit="per run")
    counted("requests without an answer", *UNANSWERED, unit="per run")
    counted("requests refused or turned away", "refused", "busy", unit="per run")
    counted("virtual time", "seconds", unit="s per run")
    report.figure("processor time", [1000 * c.processor / c.runs for c in chunks], unit="ms per run")
    if reflexive:
        counted("standbys let through", "let through", unit="per run with a reflex", of=reflexive)
        counted("robots' readers that took another instance", "taken", unit="per run with a reflex", of=reflexive)
        counted("recoveries that began with it", "fell over", unit="per run with a reflex", of=reflexive)
        counted("instances held", "held", unit="per run with a reflex", of=reflexive)
    if tasked:
        counted("goals of clients", "sent", unit="per run with tasks", of=tasked)
        counted("goals that ended", "ended", unit="per run with tasks", of=tasked)
        counted("goals that another instance took over", "resumed", unit="per run with tasks", of=tasked)
    if muxed:
        counted("commands that muxes forwarded", "forwarded", unit="per run with a mux", of=muxed)
        counted("orders of a new epoch that muxes carried out", "ordered", unit="per run with a mux", of=muxed)
        counted("switches of muxes", "switched", unit="per run with a mux", of=muxed)
        counted("switches that monitors committed", "switches committed", unit="per run with a mux", of=muxed)
        counted("journals that muxes lost", "journals lost", unit="per run with a mux", of=muxed)
    runs, steps = sum(c.runs for c in chunks), sum(c.counts["steps"] for c in chunks)
    of_each = ", ".join(
        f"{sum(c.runs for c in of)} with {name}"
        for name, of in (("a reflex", reflexive), ("tasks", tasked), ("a mux", muxed))
    )
    return report.note(
        "runs", f"{runs}, {of_each}, of {steps} steps together; a value of each figure is of {CHUNK} runs"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", type=int, nargs="?", default=10_000, help="number of runs without a reflex, tasks and a mux"
    )
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the seed of the first run")
    parser.add_argument("--only", choices=list(KINDS), help="make only runs of this kind, as many as RUNS")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), metavar="N")
    parser.add_argument("--seed", type=int, help="make only this run, and print everything that happens")
    options = parser.parse_args()
    if options.seed is not None:
        outcome = run(options.seed, tracing=True)
        print(outcome)
        sys.exit(1 if outcome.faults else 0)
    starts = {name: of.FIRST + options.first // SHARE for name, of in KINDS.items()}
    wanted = (
        {starts[options.only]: options.runs}
        if options.only
        else {options.first: options.runs, **dict.fromkeys(starts.values(), options.runs // SHARE)}
    )
    ranges = [
        range(first, min(begin + runs, first + CHUNK))
        for begin, runs in wanted.items()
        for first in range(begin, begin + runs, CHUNK)
    ]
    chunks = []
    with ProcessPoolExecutor(options.processes) as pool:
        for found in pool.map(chunk, ranges):
            chunks.append(found)
            for seed, fault in found.faults.items():
                print(f"seed {seed}: {fault}", flush=True)
            if len(chunks) % PROGRESS == 0:
                print(f"{sum(c.runs for c in chunks)} of {sum(map(len, ranges))} runs", file=sys.stderr, flush=True)
    report = told(chunks, options.only)
    print(report.table())
    failed = sorted(seed for found in chunks for seed in found.faults)
    for seed in failed[:SHOWN]:
        print(f"scripts/bench interleavings --seed {seed}")
    print(report.write())
    sys.exit(0 if report.held else 1)


if __name__ == "__main__":
    main()
