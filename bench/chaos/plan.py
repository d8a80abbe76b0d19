"""Which faults happen, when, and to whom. A seed decides all of it, so a campaign can be repeated."""

from __future__ import annotations

import math
import random
from collections.abc import Collection, Sequence
from dataclasses import dataclass

ACTIVE, STANDBY = "active", "standby"

REPLACED = 20.0
"""Seconds after which a monitor of a lost node is replaced: the test cluster replaces pods after 11, and the new one has to start."""


@dataclass(frozen=True)
class Kind:
    """A kind of fault."""

    name: str
    seconds: tuple[float, float] = (0.0, 0.0)
    """How long it lasts, from and to; 0 for a fault that is over at once."""
    shared: str = ""
    """What it affects if all robots share that, such as the API server; empty if it affects one robot. At most one fault at a time
    affects the same."""
    victims: tuple[str, ...] = ("",)
    """Which of a robot's instances may be affected; empty for none of them."""
    strengths: tuple[int, ...] = (0,)
    """Percent, or whatever else the kind needs."""
    disturbs: bool = False
    """Whether the commands of the instance that it affects may stop or be lost, so that a failover is right."""
    loses_packets: bool = False
    """Whether one reader of an instance may receive nothing while another receives enough, so that no recovery begins."""
    delays: bool = False
    """Whether a recovery may have to wait for its end: it takes away the monitor or the API server."""
    after: float = 2.0
    """Seconds from its end for which its effects may last."""
    most: float = math.inf
    """Seconds from its beginning after which a recovery must no longer wait for its end, since what it took away is replaced elsewhere."""
    muxed: bool = False
    """Whether it needs a robot with the gate kind Mux."""
    weight: float = 1.0
    """How often it happens in comparison with the others."""


KINDS = (
    Kind("kill", victims=(ACTIVE, ACTIVE, STANDBY), disturbs=True, weight=2),
    Kind("delete", victims=(ACTIVE, ACTIVE, STANDBY), disturbs=True, weight=2),
    Kind("freeze", (0.3, 15.0), victims=(ACTIVE, ACTIVE, STANDBY), disturbs=True, weight=2),
    Kind("slow", (3.0, 10.0), victims=(ACTIVE,), strengths=(50, 80, 95), disturbs=True),
    Kind(
        "packet-loss", (3.0, 10.0), victims=(ACTIVE, STANDBY), strengths=(10, 30, 60), disturbs=True, loses_packets=True
    ),
    Kind(
        "packet-delay", (3.0, 10.0), victims=(ACTIVE, STANDBY), strengths=(100, 300), disturbs=True, loses_packets=True
    ),
    Kind("flood", (3.0, 8.0), victims=(ACTIVE, STANDBY), strengths=(1000, 4000), disturbs=True),
    Kind("node-power", (8.0, 15.0), "nodes", disturbs=True, delays=True, after=15.0, most=REPLACED, weight=0.5),
    Kind("node-cut", (4.0, 20.0), "nodes", disturbs=True, delays=True, after=15.0, most=REPLACED, weight=0.5),
    Kind("monitor-kill", delays=True, after=8.0),
    Kind("monitor-freeze", (2.0, 15.0), delays=True, after=4.0),
    Kind("monitor-disk-full", (5.0, 15.0)),
    Kind("operator-kill", shared="operator", weight=0.5),
    Kind("operator-freeze", (3.0, 15.0), "operator", weight=0.5),
    Kind("api-stop", (3.0, 12.0), "API server", delays=True, after=8.0, weight=0.5),
    Kind("api-slow", (4.0, 10.0), "API server", strengths=(60, 80), delays=True, weight=0.5),
    Kind("api-flap", (6.0, 12.0), "API server", delays=True, after=4.0, weight=0.5),
    Kind("discovery-kill"),
    Kind("mux-kill", delays=True, after=4.0, muxed=True),
    Kind("mux-freeze", (0.5, 8.0), delays=True, after=4.0, muxed=True),
    Kind("gate-delete", disturbs=True, after=5.0),
    Kind("gate-edit", disturbs=True, after=5.0),
    Kind("label-remove", victims=(ACTIVE, STANDBY), disturbs=True, after=5.0),
    Kind("label-exchange", disturbs=True, after=5.0),
)

BY_NAME = {kind.name: kind for kind in KINDS}


@dataclass(frozen=True)
class Fault:
    """One fault of the plan."""

    number: int
    kind: str
    at: float
    """Seconds from the beginning of the campaign."""
    seconds: float
    """How long it lasts."""
    robot: int
    """The index of the robot; for a shared fault of the one whose active instance says which node is affected."""
    victim: str
    """``active``, ``standby``, or empty."""
    strength: int
    chance: float
    """From 0 to 1: selects among what is there at that moment, such as labels."""

    @property
    def ends(self) -> float:
        """Seconds from the beginning of the campaign to its end."""
        return self.at + self.seconds

    def __str__(self) -> str:
        length = f", {self.seconds:.1f} s" if self.seconds else ""
        strength = f", {self.strength}" if self.strength else ""
        return f"#{self.number} {self.kind} {self.victim or ''}{strength}{length}".replace(" ,", ",").strip()


def plan(
    seed: int, faults: int, robots: int, every: float, only: Collection[str] = (), muxed: Sequence[int] = ()
) -> list[Fault]:
    """Return the faults of a seed, in the order of their times.

    Args:
        robots: how many there are.
        every: mean seconds from one fault to the next.
        only: the names of the kinds to use; all if it is empty.
        muxed: the indices of the robots with the gate kind Mux.

    Raises:
        ValueError: there is no kind of such a name.
    """
    if unknown := set(only) - set(BY_NAME):
        raise ValueError(f"no such kind of fault: {', '.join(sorted(unknown))}; there are: {', '.join(BY_NAME)}")
    chance = random.Random(seed)
    kinds = [kind for kind in KINDS if (not only or kind.name in only) and (muxed or not kind.muxed)]
    found: list[Fault] = []
    now = 0.0
    while len(found) < faults:
        now += every * chance.uniform(0.4, 1.6)
        drawn = _draw(chance, kinds, robots, muxed, len(found) + 1, now)
        free = max((_free(earlier, drawn) for earlier in found), default=0.0)
        if free > now:
            if len(kinds) > 1:  # something else happens at this moment
                now -= every * 0.3
                continue
            now = free
            drawn = _draw(chance, kinds, robots, muxed, len(found) + 1, now)
        found.append(drawn)
    return found


def _draw(chance: random.Random, kinds: list[Kind], robots: int, muxed: Sequence[int], number: int, at: float) -> Fault:
    (kind,) = chance.choices(kinds, [kind.weight for kind in kinds])
    return Fault(
        number,
        kind.name,
        at=round(at, 3),
        seconds=round(chance.uniform(*kind.seconds), 3),
        robot=chance.choice(muxed if kind.muxed else range(robots)),
        victim=chance.choice(kind.victims),
        strength=chance.choice(kind.strengths),
        chance=chance.random(),
    )


def _free(earlier: Fault, later: Fault) -> float:
    """Return when a fault no longer keeps another one from happening: they must not undo each other."""
    one, other = BY_NAME[earlier.kind], BY_NAME[later.kind]
    same = one.shared == other.shared if one.shared or other.shared else earlier.robot == later.robot and one == other
    return earlier.ends + one.after if same else 0.0
