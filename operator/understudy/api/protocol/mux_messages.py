"""The texts that a monitor and a mux exchange on two topics of the robot's graph, and how each proves who wrote it. Pure.

Topics need no address and no port: wherever the commands of an instance can reach the mux, orders can too. DDS does not authenticate them,
so each text begins with a MAC by a key that HKDF (RFC 5869) derives from the token of the workload. Each direction has its own key.

An order that is recorded and sent again is harmless, because it is not newer than what the mux has carried out (mux/control.py). A report
is as fresh as the order whose ``nonce`` it repeats: a monitor uses a new one in each order.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from understudy.api import names
from understudy.api.protocol.agent_messages import ProtocolError
from understudy.api.protocol.session_keys import NotAuthentic, expanded

_SALT = b"understudy mux, version 1"

MOST = 1 << 16
"""Most characters of a text."""


@dataclass(frozen=True, order=True)
class Token:
    """What orders all decisions about one workload. A greater one is newer."""

    workload_created: float = 0.0
    """When the RobotWorkload was created, by the API server: the epochs of one that was deleted and created again begin at 0."""
    epoch: int = 0
    """The epoch of the gate object."""
    count: int = 0
    """Number of the mux's own switches in this epoch."""


@dataclass(frozen=True)
class SafeCommand:
    """A message that the mux sends to the robot while nobody controls it."""

    topic: str
    message: Mapping[str, Any]
    """Its fields, as in the policy."""
    every: float
    """Seconds between two messages."""


@dataclass(frozen=True)
class OnBoard:
    """An instance at the robot, which needs no network to the cluster: the last choice of all."""

    name: str
    silences: Mapping[str, float]
    """As in a standing order. Nobody in control counts as silent since then."""


@dataclass(frozen=True)
class StandingOrder:
    """What the mux does without another order: who is forwarded next, after which silence, and what the robot receives from nobody."""

    successors: tuple[str, ...] = ()
    """The names of instances, the first choice first."""
    silences: Mapping[str, float] = field(default_factory=dict)
    """Seconds of silence by output. An instance that is silent on one of these outputs for so long is replaced."""
    on_board: OnBoard | None = None
    safe: tuple[SafeCommand, ...] = ()
    """The safe commands of the policy (spec.safety)."""
    safe_after: float = 0.0
    """Seconds for which nobody has controlled the robot before they are sent."""

    @property
    def digest(self) -> str:
        """Identifies the content."""
        return hashlib.sha256(_compact(standing_message(self)).encode()).hexdigest()[:16]


def standing_message(standing: StandingOrder) -> dict[str, Any]:
    """Return a standing order as the content of a text or of a file."""
    found: dict[str, Any] = {"successors": list(standing.successors), "silences": dict(standing.silences)}
    if (on_board := standing.on_board) is not None:
        found["onBoard"] = {"name": on_board.name, "silences": dict(on_board.silences)}
    if standing.safe:
        found["safeAfter"] = standing.safe_after
        found["safe"] = [{"topic": one.topic, "message": one.message, "every": one.every} for one in standing.safe]
    return found


def read_standing(message: Mapping[str, Any]) -> StandingOrder:
    """Return the standing order of such a content. Raises KeyError, TypeError and ValueError for one of another version."""
    on_board = message.get("onBoard")
    return StandingOrder(
        tuple(message["successors"]),
        message["silences"],
        OnBoard(on_board["name"], on_board["silences"]) if on_board else None,
        tuple(SafeCommand(one["topic"], one["message"], one["every"]) for one in message.get("safe", ())),
        message.get("safeAfter", 0.0),
    )


@dataclass(frozen=True)
class Order:
    """What a monitor orders: the state of the gate object that it committed or read."""

    workload_created: float
    epoch: int
    source: str
    """The name of the instance to forward; empty for nobody."""
    knows: Token = Token()
    """The newest token that the monitor had seen in the mux's reports when it decided this. If the mux forwards the instance on board by
    that token, and this order is of the same epoch, control returns to the source."""
    standing: StandingOrder = StandingOrder()
    revision: int = 0
    """Grows with each standing order of one epoch."""
    mux: str = ""
    """The identity of the only mux that carries this out; empty if the monitor has heard none yet."""

    @property
    def token(self) -> Token:
        """Return the token of the decision."""
        return Token(self.workload_created, self.epoch)


@dataclass(frozen=True)
class MuxKeys:
    """The keys of one workload."""

    orders: bytes = field(repr=False)
    reports: bytes = field(repr=False)


def derive(token: bytes, namespace: str, workload: str) -> MuxKeys:
    """Return the keys of a workload whose monitors and mux know a token."""
    return MuxKeys(*(expanded(_SALT, token, use, namespace, workload) for use in ("orders", "reports")))


def topics(namespace: str, workload: str) -> tuple[str, str]:
    """Return the topics of the orders and of the reports of a workload."""
    place = "/understudy/" + "/".join(map(names.in_ros, (namespace, workload)))
    return f"{place}/mux_orders", f"{place}/mux_reports"


@dataclass(frozen=True)
class Report:
    """What a mux reports: once a second, and at once when something changes."""

    token: Token
    source: str
    """Whom it forwards; empty for nobody."""
    nonce: str
    """That of the last order that was authentic, whether it was carried out or not."""
    refused: str = ""
    """Why that order was not carried out; empty if it was."""
    forwarded: int = 0
    """Number of samples that were forwarded from this source since it was put in control."""
    since: float = math.inf
    """Seconds since the first of them; infinite if there was none."""
    heard: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Seconds since the last sample, by instance and output."""
    strangers: tuple[str, ...] = ()
    """Writers of outputs that reach the robot beside the mux, or that belong to no instance, each with its output."""
    standing: str = ""
    """The digest of the standing order that it follows."""
    revision: int = 0
    """Of the standing order."""
    on_board: bool = False
    """Whether it forwards the instance on board."""
    safe_sent: int = 0
    """Number of safe commands that it has sent since it began."""
    mux: str = ""
    """The identity of this mux: the same after a restart, unless its volume is gone."""
    ordered: str = ""
    """Whom the newest order names that was carried out; empty for nobody. The mux may have switched since."""


def sealed(message: Mapping[str, Any], key: bytes) -> str:
    """Return a message as a text with its MAC."""
    body = _compact(message)
    return f"{hmac.digest(key, body.encode(), 'sha256').hex()} {body}"


def _compact(message: Mapping[str, Any]) -> str:
    return json.dumps(message, separators=(",", ":"), sort_keys=True)


def opened(text: str, key: bytes) -> dict[str, Any]:
    """Return the message of a text. Raises NotAuthentic if it was not sealed with this key."""
    mac, _, body = text[:MOST].partition(" ")
    if not hmac.compare_digest(mac.encode(), hmac.digest(key, body.encode(), "sha256").hex().encode()):
        raise NotAuthentic("the text was not written by somebody who knows the token of the workload")
    found: dict[str, Any] = json.loads(body)
    return found


def order_text(order: Order, nonce: str, keys: MuxKeys) -> str:
    """Return the text of an order."""
    message = {
        "token": _token(order.token),
        "source": order.source,
        "knows": _token(order.knows),
        "standing": standing_message(order.standing),
        "revision": order.revision,
        "mux": order.mux,
        "nonce": nonce,
    }
    return sealed(message, keys.orders)


def read_order(text: str, keys: MuxKeys) -> tuple[Order, str]:
    """Return the order of a text, and its nonce. Raises NotAuthentic, and ProtocolError for one of another version."""
    message = opened(text, keys.orders)
    try:
        token = Token(*message["token"])
        order = Order(
            token.workload_created,
            token.epoch,
            message["source"],
            Token(*message["knows"]),
            read_standing(message["standing"]),
            message["revision"],
            message["mux"],
        )
        return order, message["nonce"]
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"the order is of another version: {error!r}") from error


def report_text(report: Report, keys: MuxKeys) -> str:
    """Return the text of a report."""
    message = {
        "token": _token(report.token),
        "source": report.source,
        "nonce": report.nonce,
        "refused": report.refused,
        "forwarded": report.forwarded,
        "since": report.since if math.isfinite(report.since) else None,
        "heard": {name: dict(outputs) for name, outputs in report.heard.items()},
        "strangers": list(report.strangers),
        "standing": report.standing,
        "revision": report.revision,
        "onBoard": report.on_board,
        "safeSent": report.safe_sent,
        "mux": report.mux,
        "ordered": report.ordered,
    }
    return sealed(message, keys.reports)


def read_report(text: str, keys: MuxKeys) -> Report:
    """Return the report of a text. Raises NotAuthentic, and ProtocolError for one of another version."""
    message = opened(text, keys.reports)
    try:
        return Report(
            Token(*message["token"]),
            message["source"],
            message["nonce"],
            message["refused"],
            message["forwarded"],
            math.inf if message["since"] is None else message["since"],
            message["heard"],
            tuple(message["strangers"]),
            message["standing"],
            message["revision"],
            message["onBoard"],
            message["safeSent"],
            message["mux"],
            message["ordered"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"the report is of another version: {error!r}") from error


def _token(token: Token) -> list[float]:
    return [token.workload_created, token.epoch, token.count]
