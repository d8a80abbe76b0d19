"""The monitor's end of an agent's control channel."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from understudy.api.protocol import agent_messages as wire
from understudy.api.protocol import secure_channel
from understudy.api.protocol.agent_messages import PROTOCOL, AgentStatus, GateEpoch, ProtocolError
from understudy.api.protocol.secure_channel import AgentDeclined, Channel, MonitorSecret

_logger = logging.getLogger(__name__)

RETRY_FIRST, RETRY_MOST = 0.05, 1.0  # seconds
CONNECT_FIRST, CONNECT_MOST = (
    0.25,
    1.0,
)  # seconds; finds a policy that has just opened sooner than the kernel's SYN retries do
GREETING = 3.0  # seconds
ANSWER = 5.0  # seconds


class AgentGone(ConnectionError):
    """There is no connection to the agent, or it was lost before the answer arrived.

    The agent may have carried out the request.
    """


class AgentRefused(Exception):
    """The agent answered that it refuses a request or cannot carry it out."""


class AgentLink:
    """A connection to one agent that is kept up in the background until it is closed. Needs a running event loop.

    Requests can be repeated: repeating one has the same effect.
    """

    def __init__(
        self,
        host: str,
        port: int,
        secret: MonitorSecret,
        workload: str,
        claim: str,
        *,
        uid: str,
        pod: str = "",
        protocol: int = PROTOCOL,
        epoch: Callable[[], GateEpoch] = GateEpoch,
        on_change: Callable[[AgentLink], None] | None = None,
        on_event: Callable[[AgentLink, Mapping[str, Any]], None] | None = None,
    ) -> None:
        """Start to connect to the agent of the pod with this UID; ``pod`` is its name, for messages.

        ``protocol`` is the version of the protocol that the agent knows at least. An older one is not accepted, because somebody else
        could answer at the pod's address. ``epoch`` returns the epoch of the gate as this side knows it, which every request carries.
        ``on_change`` is called with each status, and when the connection is made or lost; ``on_event`` with each event.
        Events that happen while there is no connection are lost. A caller that depends on them must ask again after
        reconnecting.
        """
        self.host, self.port, self.workload, self.claim = host, port, workload, claim
        self.uid, self.pod, self._protocol = uid, pod, protocol
        self._epoch = epoch
        self.secret = secret
        """What proves this side to the agent. A change takes effect with the next session."""
        self._on_change, self._on_event = on_change, on_event
        self._status: AgentStatus | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._channel: Channel | None = None
        self._numbers = itertools.count(1)
        self._seen = 0
        """Number of the last status that was received in this session; 0 if the agent does not number them."""
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._changed = asyncio.Event()
        self._accepted = False
        self._closed = False
        self.sessions = 0
        """Number of times that the connection was made."""
        self.refused = False
        """Whether the last attempt reached the agent and the agent refused this side."""
        self.problem = f"connecting to {host}:{port}"
        """Why there is no connection; empty while there is one."""
        self._task = asyncio.create_task(self._run(), name=f"agent {host}")

    @property
    def connected(self) -> bool:
        """Whether the agent accepted this session and has sent something within the last seconds."""
        return self._writer is not None and not self._closed

    @property
    def probe_key(self) -> bytes:
        """Authenticates the gate probes that the agent sends for this session; empty without a connection, and in version 1."""
        return self._channel.probe_key if self._channel is not None else b""

    @property
    def status(self) -> AgentStatus | None:
        """The agent's last status; None while there is no connection, since the last one may be out of date."""
        return self._status

    async def wait_connected(self, within: float | None = None) -> None:
        """Wait for the connection. Raises AgentGone with the reason if there is none within ``within`` seconds, or if it is closed."""
        try:
            async with asyncio.timeout(within):
                while not self.connected:
                    await self._change()
        except TimeoutError:
            raise AgentGone(self.problem) from None

    async def wait_for(self, predicate: Callable[[AgentStatus], bool], within: float | None = None) -> AgentStatus:
        """Return the first status that satisfies the predicate, waiting through lost connections.

        Raises TimeoutError, with the last status or problem, if none does within ``within`` seconds, and AgentGone if the connection is
        closed.
        """
        try:
            async with asyncio.timeout(within):
                while self._status is None or not predicate(self._status):
                    await self._change()
                return self._status
        except TimeoutError:
            last = self.problem or (self._status and (self._status.reason or self._status.phase)) or "no status yet"
            raise TimeoutError(f"agent {self.pod or self.host}: not within {within:g} s: {last}") from None

    async def configure(
        self,
        tree: Mapping[str, Any] | str,
        outputs: Sequence[Mapping[str, Any]],
        grace: float,
        *,
        form: str = "yaml",
        probe: tuple[str, int] | None = None,
        standby: Mapping[str, Any] | None = None,
        managed: bool = False,
    ) -> None:
        """Send the health tree (of the policy's ``monitoring``) and the workload's outputs, in their wire form.

        ``form`` is the language of the tree, ``grace`` is in seconds. ``probe`` is the address to which the agent sends its probe of every
        second; the default is this side of the connection, at the probe port. ``standby`` defines when a waiting instance is ready
        (agent/readiness.py). ``managed`` is whether procedures bring the instance's nodes up. Raises AgentRefused (for example if the tree
        does not load) and AgentGone.
        """
        body: dict[str, Any] = {"tree": tree, "outputs": list(outputs), "grace": grace}
        if form != "yaml":
            body["form"] = form
        if standby is not None:
            body["standby"] = standby
        if managed:
            body["managed"] = True
        if probe is not None:
            body["probe"] = {"host": probe[0], "port": probe[1]}
        await self.request("configure", body | {"events": self._on_event is not None})

    async def start(
        self, environment: Mapping[str, Mapping[str, str]], ros: Mapping[str, str], *, profiles: str = ""
    ) -> None:
        """Start the held containers, each with its environment, in a robot's ROS graph.

        ``profiles`` are DDS profiles for all processes of the pod, if they need any.

        Raises AgentRefused, for example if another claim came first, and AgentGone.
        """
        await self.request("start", {"environment": environment, "ros": ros, "profiles": profiles})

    async def procedure(
        self,
        tree: Mapping[str, Any],
        within: float,
        *,
        name: str,
        state: Mapping[str, Any] | None = None,
        brought: str = "",
        places: Mapping[str, str] | None = None,
        epoch: GateEpoch | None = None,
    ) -> Mapping[str, Any]:
        """Run a procedure on the agent's instance for at most ``within`` seconds.

        It replaces a procedure that is running. ``state`` is kept state in its wire form for the procedure's leaves.
        The agent remembers the success under the name ``brought``. ``places`` has the positions of the nodes in the text,
        if it is not in the short form. ``epoch`` is that of the decision, if it is not the present one. The answer reports the
        outcome of the state. Raises AgentRefused with the reason if the procedure failed, and AgentGone.
        """
        body: dict[str, Any] = {"tree": tree, "within": within, "name": name, "state": state, "as": brought}
        if places:
            body["places"] = places
        answer = await self.request("procedure", body, within=within + ANSWER, epoch=epoch)
        found: Mapping[str, Any] = answer.get("report") or {}
        return found

    async def close(self) -> None:
        """Close the connection. Requests in flight fail, and those who wait for it or for a status get AgentGone."""
        self._closed = True
        self._changed.set()
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task

    async def request(
        self, op: str, body: Mapping[str, Any], *, within: float = ANSWER, epoch: GateEpoch | None = None
    ) -> dict[str, Any]:
        """Request an operation and wait at most ``within`` seconds for the answer.

        ``epoch`` is that of the decision, if it is not the present one.

        Raises AgentRefused and AgentGone.
        """
        writer, channel = self._writer, self._channel
        if writer is None or channel is None:
            raise AgentGone(f"agent {self.host}: {self.problem}")
        number = next(self._numbers)
        seen = {"seen": self._seen} if self._seen else {}
        message = {"id": number, "op": op, "gate": (epoch or self._epoch()).to_wire(), **seen, **body}
        answer: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._answers[number] = answer
        try:
            async with asyncio.timeout(within):
                try:
                    channel.write(message)
                    await writer.drain()
                except OSError as error:
                    raise AgentGone(f"agent {self.host}: {error}") from error
                found = await answer
        except TimeoutError:
            raise AgentGone(f"agent {self.host}: no answer to {op} within {within:g} s") from None
        finally:
            self._answers.pop(number, None)
            if answer.done() and not answer.cancelled():
                answer.exception()  # if the connection was lost before anybody waited for it, asyncio would log a traceback
        if found.get("heldBack"):
            raise AgentGone(f"agent {self.pod or self.host}: {op}: {found['error']}")
        if "error" in found:
            raise AgentRefused(f"agent {self.pod or self.host}: {op}: {found['error']}")
        return found

    async def _run(self) -> None:
        retry, patience = RETRY_FIRST, CONNECT_FIRST
        while True:
            writer: asyncio.StreamWriter | None = None
            self._accepted = refused = False
            try:
                async with asyncio.timeout(patience):
                    reader, writer = await asyncio.open_connection(self.host, self.port, limit=secure_channel.BUFFER)
                async with asyncio.timeout(GREETING):
                    channel = await self._greet(reader, writer)
                await self._read(channel)
            except TimeoutError:
                problem = f"silent for {wire.SILENCE:g} s" if self.connected else "no answer"
            except (OSError, EOFError, ValueError, ProtocolError) as error:
                problem = _words(error)
            except (AgentRefused, AgentDeclined) as error:
                problem = str(error)
                refused = True
                retry = RETRY_MOST  # a wrong token or another claim does not change within milliseconds
            except Exception as error:
                _logger.exception("agent %s:%s", self.host, self.port)
                problem = repr(error)
            finally:
                self._disconnect(writer)
            if self._accepted:
                retry, patience = RETRY_FIRST, CONNECT_FIRST
            if problem != self.problem:
                _logger.info("agent %s (%s:%s): %s", self.pod or "?", self.host, self.port, problem)
            self.problem, self.refused = problem, refused
            self._notify()
            await asyncio.sleep(retry)
            retry, patience = min(2 * retry, RETRY_MOST), min(2 * patience, CONNECT_MOST)

    async def _greet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Channel:
        """Begin a session, and read its first message: a status or a refusal.

        Raises AgentRefused, AgentDeclined and ProtocolError.
        """
        channel = await secure_channel.connect(
            reader,
            writer,
            uid=self.uid,
            secret=self.secret,
            workload=self.workload,
            claim=self.claim,
            oldest=self._protocol,
        )
        first = await channel.read()
        if "error" in first:
            raise AgentRefused(str(first["error"]))
        status = AgentStatus.from_wire(first.get("status", {}))
        self._seen = int(first.get("number", 0))
        self._writer, self._channel, self._status, self.problem, self._accepted = writer, channel, status, "", True
        self.refused = False
        self.sessions += 1
        self._notify()
        return channel

    async def _read(self, channel: Channel) -> None:
        while True:
            async with asyncio.timeout(wire.SILENCE):
                message = await channel.read()
            if "status" in message and "id" not in message:
                self._status, self._seen = AgentStatus.from_wire(message["status"]), int(message.get("number", 0))
                self._notify()
            elif "event" in message and "id" not in message:
                self._notify_event(message["event"])
            elif isinstance(number := message.get("id"), int):
                answer = self._answers.get(number)
                if answer is not None and not answer.done():
                    answer.set_result(message)
            elif "error" in message:
                raise AgentRefused(str(message["error"]))

    def _disconnect(self, writer: asyncio.StreamWriter | None) -> None:
        self._writer = self._channel = self._status = None
        if writer is not None:
            # A command must not arrive later, when another monitor may have put the instance in control.
            wire.reset(writer)
        for answer in self._answers.values():
            if not answer.done():
                answer.set_exception(AgentGone(f"agent {self.pod or self.host}: the connection was lost"))

    def _notify_event(self, event: object) -> None:
        if self._on_event is None or not isinstance(event, dict):
            return
        try:
            self._on_event(self, event)
        except Exception:
            _logger.exception("an event of agent %s", self.pod or self.host)

    async def _change(self) -> None:
        """Wait for the next change. Raises AgentGone if the connection is closed."""
        if not self._closed:
            await self._changed.wait()
        if self._closed:
            raise AgentGone(f"agent {self.pod or self.host}: the connection was closed on this side")

    def _notify(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()
        if self._on_change is not None:
            try:
                self._on_change(self)
            except Exception:
                _logger.exception("noting a change of agent %s", self.pod or self.host)


def _words(error: BaseException) -> str:
    """Return the error's text without the address, which the log line already has."""
    if isinstance(error, OSError) and error.errno is not None:
        return os.strerror(error.errno)
    return str(error) or repr(error)
