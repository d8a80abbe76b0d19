"""Finds former drivers of which nobody can tell whether they still call the robot's services and actions.

A call is not heard, and the test packets of an agent stand for it. For a pod without an agent, or one whose agent this monitor has not
reached, only discovery shows anything: that the process lives and has a client.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from understudy.kube.gates.base import Proof
from understudy.monitor.observe.robot.known_senders import Caller, KnownSender

PERIOD = 1.0
"""Seconds between two checks of discovery."""

LASTS = 5.0
"""Seconds after which a possible sender is reported. A new monitor needs a moment to reach an agent, and an instance one to end."""

FORGOTTEN = 25.0
"""Seconds after which discovery has forgotten a process that ended without a word: 20 s, and a margin. A process
that is still there lives, and waiting for longer would show nothing else."""


@dataclass(frozen=True)
class PossibleSender:
    """A former driver that may still call the robot."""

    name: str
    uid: str
    outputs: tuple[str, ...]
    """The services and actions of which it has a client."""
    is_gone: bool
    """Whether its pod is being deleted or is gone, so that the gate may not hold it back."""
    since: float
    """Since when it may call without being let through, in Unix seconds."""


class Callers(Protocol):
    """What discovery knows of clients."""

    def callers(self) -> Sequence[Caller]:
        """Return which instances have a client of an output that is a service or an action."""


class PossibleSenders:
    """The possible senders of one workload. Times are Unix seconds."""

    def __init__(self, probes: Proof, outputs: Callers) -> None:
        self._probes, self._outputs = probes, outputs
        self._found: dict[str, PossibleSender] = {}
        self._updated = 0.0

    def update(
        self, formers: Sequence[KnownSender], gone: Collection[str], let_through: Collection[str], now: float
    ) -> None:
        """Follow these former drivers, at most every PERIOD seconds. Discovery is only asked if there is one that matters.

        ``gone`` and ``let_through`` have the UIDs of those whose pods are being deleted or are gone, and of those that the gate names.
        """
        self._found = {uid: one for uid, one in self._found.items() if uid not in let_through}
        if 0 <= now - self._updated < PERIOD:
            return
        self._updated = now
        suspects = {
            one.uid: one for one in formers if one.uid not in let_through and not self._probes.recognizes(one.uid)
        }
        clients: dict[str, list[str]] = {}
        for caller in self._outputs.callers() if suspects else ():
            # If it may be one that is let through, it is taken for that.
            if caller.may_be[0] in suspects and not any(uid in let_through for uid in caller.may_be):
                clients.setdefault(caller.may_be[0], []).append(caller.output)
        self._found = {
            uid: PossibleSender(
                suspects[uid].name,
                uid,
                tuple(sorted(outputs)),
                uid in gone,
                self._found[uid].since if uid in self._found else now,
            )
            for uid, outputs in clients.items()
        }

    def shift(self, step: float) -> None:
        """Move all times after the clock was set by ``step`` seconds."""
        self._updated += step
        self._found = {uid: replace(one, since=one.since + step) for uid, one in self._found.items()}

    def lasting(self, now: float) -> Sequence[PossibleSender]:
        """Return those that have lasted for LASTS seconds, by name."""
        return sorted((one for one in self._found.values() if now - one.since >= LASTS), key=lambda one: one.name)

    def may_drive(self, now: float, rightful: str) -> bool:
        """Return whether the gate must not open for another instance yet, because the process of one that is gone may live.

        ``rightful`` is the UID of the instance for which the gate was closed.
        """
        return any(one.is_gone and one.uid != rightful and now - one.since < FORGOTTEN for one in self._found.values())
