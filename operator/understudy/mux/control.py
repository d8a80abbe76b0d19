"""Decides whom a mux forwards: by the orders of monitors, and by standing orders while nobody gives any. Pure.

Each decision has a token that only grows: the epoch of the gate object, and a count of the switches that the mux made by itself in this
epoch. The gate object stays the commit point, so an order only passes on what was committed. But a monitor that was cut off does not know
whom the mux has put in control meanwhile. Its order is refused until the monitor knows that switch, so it never undoes it by accident.

All times are seconds of one monotonic clock of the process.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from understudy.api.protocol.mux_messages import Order, StandingOrder, Token


@dataclass(frozen=True)
class Control:
    """Whom the mux forwards. It is kept on disk, so that a mux that restarts continues with it."""

    token: Token = field(default_factory=Token)
    source: str = ""
    """Empty for nobody."""
    ordered: str = ""
    """Whom the order of this epoch names. It differs from ``source`` after a switch of the mux's own."""
    standing: StandingOrder = field(default_factory=StandingOrder)
    revision: int = -1
    """Revision of the standing order."""
    replaced: tuple[str, ...] = ()
    """Whom the mux has replaced in this epoch: they are not forwarded again without an order."""
    on_board: bool = False
    """Whether the source is the instance on board. It only stands in: any newer order of the cluster replaces it."""

    @property
    def newest(self) -> Token:
        """The token of the newest order that was carried out."""
        return replace(self.token, count=0)


class Refused(Exception):
    """An order that is not carried out. The text is the reason."""


def ordered(control: Control, order: Order) -> Control:
    """Return the control after an order. The same order again changes nothing.

    An order of the present epoch that knows a switch to the instance on board returns control from it. One of a newer epoch that names
    nobody leaves that instance in control, if it is still allowed to. Raises Refused if the order is older than the control, or was given
    without knowing a switch of the mux's own to another instance of the cluster.
    """
    present = control.newest
    if order.token < present:
        raise Refused(
            f"the order is of epoch {order.epoch}, and the mux has carried out one of epoch {present.epoch}"
            if order.workload_created == present.workload_created
            else "the order is of a RobotWorkload that was replaced by another one of this name"
        )
    if order.token == present:
        if order.source != control.ordered:
            raise Refused(
                f"the order of epoch {order.epoch} names {_named(order.source)}, and an earlier one {_named(control.ordered)}"
            )
        if control.on_board and order.source and order.knows == control.token:
            return Control(_counted(control.token), order.source, order.source, order.standing, order.revision)
        if order.revision <= control.revision:
            return control
        return replace(control, standing=order.standing, revision=order.revision)
    is_same_workload = order.workload_created == present.workload_created
    # Nobody is put in control by an order that names nobody, or whom the mux forwards already.
    undoes = order.source not in ("", control.source) and not control.on_board
    if undoes and is_same_workload and control.token.count and order.knows < control.token:
        raise Refused(
            f"the mux has switched to {_named(control.source)} by itself (switch {control.token.count} of epoch {present.epoch}), which "
            "the order does not take into account"
        )
    if control.on_board and is_same_workload and not order.source and _is_on_board(control.source, order.standing):
        return Control(
            _counted(order.token), control.source, "", order.standing, order.revision, control.replaced, on_board=True
        )
    return Control(order.token, order.source, order.source, order.standing, order.revision)


def aside(control: Control, order: Order) -> Control:
    """Return the control of a mux after an order for another mux of the workload: it forwards nobody until an order is for it again.

    Raises Refused if the order is older than the control.
    """
    if order.token < control.newest:
        raise Refused(f"the order is for another mux, {order.mux}, and older than what this one has carried out")
    # An order of the same epoch for this mux is carried out again.
    return Control(replace(order.token, epoch=order.epoch - 1))


def _counted(token: Token) -> Token:
    return replace(token, count=token.count + 1)


def _named(source: str) -> str:
    return source or "nobody"


@dataclass(frozen=True)
class Heard:
    """When instances were last heard, and since when the mux forwards the present one."""

    since: float
    """When the mux began to forward the present instance, or to listen."""
    last: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Time of the last sample by instance and output."""
    discovered_by: float = 0.0
    """Until when the process may not have discovered an instance that sends: one that was never heard is not silent before."""

    def silent_at(self, source: str, silences: Mapping[str, float]) -> float:
        """Return when an instance has been silent for too long, if it is not heard again; infinite if no silence counts."""
        last = self.last.get(source, {})
        return min(
            (max(self.since, last.get(output, self.discovered_by)) + most for output, most in silences.items()),
            default=math.inf,
        )

    def drives(self, source: str, silences: Mapping[str, float], now: float) -> bool:
        """Return whether an instance sends on all outputs whose silence counts."""
        last = self.last.get(source, {})
        return all(now - last.get(output, -math.inf) < most for output, most in silences.items())


def due_at(control: Control, heard: Heard) -> float:
    """Return when :func:`switched` must be asked at the latest; infinite if no standing order applies."""
    return min((heard.silent_at(control.source, silences) for _, silences in _choices(control)), default=math.inf)


def switched(control: Control, heard: Heard, now: float) -> Control | None:
    """Return the control after a switch of the mux's own; None if the present instance is heard, or nobody else is.

    All samples that had arrived before ``now`` must have been noted: a process that stood still has not heard anybody meanwhile.
    """
    for source, silences in _choices(control):
        if now >= heard.silent_at(control.source, silences) and heard.drives(source, silences, now):
            return replace(
                control,
                token=_counted(control.token),
                source=source,
                replaced=(*control.replaced, control.source),
                on_board=_is_on_board(source, control.standing),
            )
    return None


def _choices(control: Control) -> list[tuple[str, Mapping[str, float]]]:
    """Return who may be forwarded next, each with the silences after which."""
    standing, not_again = control.standing, {control.source, *control.replaced}
    # If nobody is in control, somebody decided that. Only who stands in may end it.
    successors = [one for one in standing.successors if one not in not_again] if control.source else []
    found = [(one, standing.silences) for one in successors]
    if (on_board := standing.on_board) is not None and control.source != on_board.name:
        found.append((on_board.name, on_board.silences))
    return found


def _is_on_board(source: str, standing: StandingOrder) -> bool:
    return standing.on_board is not None and standing.on_board.name == source


def undriven_at(control: Control, heard: Heard) -> float:
    """Return when safe commands may begin, if nobody is heard until then; infinite if the standing order has none.

    If an instance is in control, it may be idle. So they begin only if its silence counts, and only if it is silent on all outputs.
    """
    standing = control.standing
    if not standing.safe:
        return math.inf
    if not control.source:
        return heard.since + standing.safe_after
    silences = [*standing.silences.values(), *(standing.on_board.silences.values() if standing.on_board else ())]
    last = max(heard.last.get(control.source, {}).values(), default=heard.discovered_by)
    return max(heard.since, last) + min(silences, default=math.inf) + standing.safe_after
