"""Sends generated objects to a running operator and a running monitor, and measures what other workloads notice of it.

    scripts/bench fuzz [--seed 1] [--objects 20000] [--minutes 120] [--only SEED ...] [--unaided] [--show SEED]

Each object has a seed of its own. Hypothesis draws it from the schemas of the three kinds and the grammars of the tree
languages, by its schema or with mutations. It is created, or it changes an object that exists, or it changes what the
monitor of a running workload reads. Other robots fail meanwhile, and a small workload is created from time to time.

With ``--unaided`` no cluster is needed: the functions of operator and monitor are given the objects in this process.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter


def main() -> int:
    parser = argparse.ArgumentParser(
        "scripts/bench fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the first object")
    parser.add_argument("--objects", type=int, default=20_000, metavar="N")
    parser.add_argument("--only", type=int, nargs="+", default=[], metavar="SEED", help="send only these objects")
    parser.add_argument("--show", type=int, metavar="SEED", help="print one object, and send none")
    parser.add_argument("--unaided", action="store_true", help="use no cluster")
    parser.add_argument("--alive", type=int, default=24, metavar="N", help="objects that exist at the same time")
    parser.add_argument(
        "--before", type=int, default=4, metavar="N", help="failures of each robot before the first object"
    )
    parser.add_argument("--minutes", type=float, default=120, help="end after this time, with fewer objects")
    parser.add_argument("--keep", action="store_true", help="keep the namespaces")
    options = parser.parse_args()
    if options.show is not None:
        from bench.fuzz.samples import sample

        print(sample(options.show).text)
        return 0
    if options.unaided:
        return unaided(options.only or range(options.seed, options.seed + options.objects))
    assert "KUBECONFIG" in os.environ, "scripts/bench sets it"
    from bench.fuzz.campaign import Options, run

    return run(
        Options(
            options.seed, options.objects, options.only, options.alive, options.before, options.minutes, options.keep
        )
    )


def unaided(numbers: range | list[int]) -> int:
    """Try the objects in this process, and print the faults."""
    import logging

    from bench.fuzz.samples import sample
    from bench.fuzz.unaided import tried

    logging.disable(logging.CRITICAL)
    counts, slowest, faults = Counter[str](), dict[str, tuple[float, int]](), 0
    for number in numbers:
        trial = tried(sample(number))
        counts[f"{trial.sample.kind} {'refused' if trial.refused else 'taken'}"] += 1
        for step, seconds in trial.seconds.items():
            slowest[step] = max(slowest.get(step, (0.0, 0)), (seconds, number))
        for fault in trial.faults:
            faults += 1
            print(f"{trial.sample}: {fault}", flush=True)
    print(dict(counts))
    for step, (seconds, number) in sorted(slowest.items(), key=lambda item: -item[1][0]):
        print(f"{step}: at most {1000 * seconds:.1f} ms (seed {number})")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
