"""What lies between a process and the API server: delays, lost requests, lost answers, errors, watches that lag and break."""

from __future__ import annotations

import asyncio
import json
import random
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import aiohttp

from tests.support.answers import tabled
from tests.unit.interleavings.apiserver import ApiServer, selecting, watch_event
from tests.unit.interleavings.scheduling import Process, VirtualLoop
from tests.unit.interleavings.tcp import Tcp
from understudy.kube.api_contact import ApiContact
from understudy.kube.client import SILENCE, TABLE, ApiError, Client, Expired, Object, Resource

GIVEN_UP = (14.0, SILENCE)
"""Seconds after which a connection without data ends: the kernel gives it up after three probes without an answer, and the client gives it
up if a proxy answers them."""


@dataclass
class Weather:
    """How bad it is: how often each thing goes wrong, of all requests or of all deliveries by a watch."""

    refused: float = 0.0
    """The request never arrives, and that is known at once."""
    lost: float = 0.0
    """The request never arrives, and the client receives no error."""
    unanswered: float = 0.0
    """It is carried out, and the connection breaks before the answer."""
    unheard: float = 0.0
    """The request is carried out, and the client receives no answer."""
    late: float = 0.0
    """It is carried out after its sender has given it up."""
    busy: float = 0.0
    """429, 500 or 503, and it isn't carried out."""
    gateway: float = 0.0
    """504, and it is carried out."""
    slow: float = 0.0
    """It takes up to seconds to arrive, or to be answered."""
    lag: float = 0.0
    """A watch brings things only after up to seconds."""
    broken: float = 0.0
    """A watch ends, or is refused since it's too old."""

    @classmethod
    def of(cls, bad: float) -> Weather:
        """As bad as this factor says."""
        return cls(
            refused=0.015 * bad,
            lost=0.01 * bad,
            unanswered=0.015 * bad,
            unheard=0.01 * bad,
            late=0.005 * bad,
            busy=0.015 * bad,
            gateway=0.01 * bad,
            slow=0.06 * bad,
            lag=0.08 * bad,
            broken=0.01 * bad,
        )


class Network:
    """The network and the weather in it."""

    def __init__(self, loop: VirtualLoop, server: ApiServer, choices: random.Random, world: Process) -> None:
        self.loop, self.server, self.choices, self._world = loop, server, choices, world
        self.weather = Weather()
        self.noted: Callable[[str], None] = lambda text: None
        self.sending: Callable[[Process, str, str], None] = lambda process, method, path: None
        """Called with a process that sends a request, its method and its path; not where the server is only to judge it."""
        self.cut_off: set[Process] = set()
        """Processes of which nothing arrives, and to which nothing comes."""
        self.tcp = Tcp(loop, world, self.link_delay)
        """The connections between monitors and agents."""
        self.apart: set[Process] = set()
        """Processes that reach no pod, and that no pod reaches."""
        self.unreachable: set[str] = set()
        """Addresses that nobody reaches."""
        self.tcp.open = lambda process, host: process not in self.apart and host not in self.unreachable
        self.denied: set[Process] = set()
        """Processes of whose writes every second one is refused for good, as by an API server that knows only a part of their roles."""
        self._waiting: dict[str, list[asyncio.Future[None]]] = {}
        self.outcomes: dict[str, int] = {}
        self.carries_late = False
        """Whether the request that the server carries out now was given up by its sender long ago."""
        self.half_open: dict[tuple[Process, str], float] = {}
        """Watches of processes over connections that are dead, by resource, and when such a connection is given up."""

    def client(self, process: Process, *, timeout: float = 10.0) -> SimulatedClient:
        """The client of a process."""
        return SimulatedClient(self, process, timeout)

    def delay(self) -> float:
        """Seconds for one way."""
        roll = self.choices.random()
        return roll * 2.0 if self.choices.random() < self.weather.slow else 0.0005 + roll * 0.006

    def link_delay(self) -> float:
        """Seconds for one way between a monitor and a pod."""
        roll = self.choices.random()
        return roll * 0.3 if self.choices.random() < self.weather.slow else 0.0002 + roll * 0.002

    def set_apart(self, processes: Iterable[Process], so: bool) -> None:
        """Cut processes off from all pods, or join them again."""
        if so:
            self.apart.update(processes)
        else:
            self.apart.difference_update(processes)
            self.tcp.changed()

    def fate(self) -> str:
        """Returns the fate of a request."""
        roll = self.choices.random()
        weather = self.weather
        for name in ("refused", "lost", "unanswered", "unheard", "late", "busy", "gateway"):
            roll -= getattr(weather, name)
            if roll < 0:
                return name
        return "answered"

    def remembered(self, path: str, params: Mapping[str, str] | None) -> Mapping[str, str] | None:
        """A request's parameters; where it may be answered from memory, with a version of what is remembered, which may lag."""
        if params is None or params.get("resourceVersion") != "0":
            return params
        history = self.server.history[path.rpartition("/")[2]]
        lag = self.choices.randrange(len(history[-8:]) + 1) if self.choices.random() < self.weather.lag else 0
        version = history[-lag].version - 1 if lag else self.server.version
        return {**params, "resourceVersion": str(version)}

    def later(self, seconds: float, work: Callable[..., None], *args: Any, process: Process | None = None) -> None:
        """Do something after so many seconds, in a process or in the world."""
        self.loop.call_later(seconds, work, *args, context=(process or self._world).context)

    def fall_silent(self, process: Process, plural: str) -> None:
        """The connection of a watch dies without a sign, or a proxy keeps it open and delivers nothing."""
        self.half_open[process, plural] = self.loop.time() + self.choices.choice(GIVEN_UP)
        self.written(plural)

    def written(self, plural: str) -> None:
        """Wake the watches of a resource."""
        for future in self._waiting.pop(plural, []):
            if not future.done():
                future.set_result(None)

    async def wait(self, plural: str) -> None:
        """Wait for a write of a resource."""
        future: asyncio.Future[None] = self.loop.create_future()
        self._waiting.setdefault(plural, []).append(future)
        await future

    def count(self, outcome: str) -> None:
        """Count the fates of requests."""
        self.outcomes[outcome] = self.outcomes.get(outcome, 0) + 1


class SimulatedClient(Client):
    """The real client's methods over the simulated network."""

    def __init__(self, network: Network, process: Process, timeout: float) -> None:
        self._network, self._process, self._seconds = network, process, timeout
        self.contact = ApiContact()

    async def request(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, str] | None = None,
        body: Any = None,
        content_type: str = "application/json",
    ) -> Object:
        network, process = self._network, self._process
        if "dryRun" not in (params or {}):
            network.sending(process, method, path)
        answer: asyncio.Future[Object] = network.loop.create_future()
        fate = "lost" if process in network.cut_off else network.fate()
        if method != "GET" and process in network.denied and network.choices.random() < 0.5:
            fate = "denied"
        short = f"{method} {path.rpartition('/namespaces/')[2]}"
        network.count(fate)
        if fate != "answered":
            network.noted(f"{process}: {short}: {fate}")

        def answered(result: Object | ApiError | Exception) -> None:
            if answer.done():
                return
            if process in network.cut_off:
                network.later(self._seconds, self._gave_up, answer, process=process)
                return
            if isinstance(result, BaseException):
                answer.set_exception(result)
            else:
                answer.set_result(result)

        def arrive() -> None:
            result: Object | ApiError | Exception
            try:
                known_version = network.remembered(path, params)
                network.carries_late = fate == "late"
                result = network.server.request(method, path, known_version, body, content_type, process.name)
            except ApiError as error:
                result = error
                if error.conflict:
                    network.count("conflict")
            finally:
                network.carries_late = False
            if method != "GET":
                network.noted(f"{process}: {short}: {result if isinstance(result, ApiError) else 'done'}")
            if fate == "unanswered":
                result = aiohttp.ServerDisconnectedError()
            elif fate == "gateway":
                result = ApiError(504, "Timeout", "the server did not answer in time")
            elif fate in ("unheard", "late"):
                return
            network.later(network.delay(), answered, result, process=process)

        if fate == "refused":
            network.later(0.001, answered, aiohttp.ClientConnectionError("refused"), process=process)
        elif fate == "busy":
            status = network.choices.choice([429, 500, 503])
            network.later(network.delay(), answered, ApiError(status, "Busy", "try again"), process=process)
        elif fate == "denied":
            denied = ApiError(403, "Forbidden", "no role allows it", just_back=self.contact.just_back)
            network.later(network.delay(), answered, denied, process=process)
        elif fate == "late":
            network.later(self._seconds + network.choices.random() * 4, arrive)
        elif fate != "lost":
            network.later(network.delay(), arrive)
        if fate not in ("answered", "refused", "busy", "denied"):
            network.later(self._seconds, self._gave_up, answer, process=process)
        with self.contact.asking():
            try:
                return await answer
            except ApiError as error:
                if error.unauthenticated:
                    raise
                refusal = error
        raise refusal

    async def read(
        self, path: str, *, params: Mapping[str, str] | None = None, accept: str = "application/json"
    ) -> bytes:
        answer = await self.request("GET", path, params=params)
        if accept == TABLE:
            return json.dumps(tabled(answer)).encode()
        head = json.dumps({**answer, "items": []}, separators=(",", ":")).encode()
        return head[:-2] + b",".join(map(self._network.server.encoded, answer["items"])) + b"]}"

    @staticmethod
    def _gave_up(answer: asyncio.Future[Object]) -> None:
        if not answer.done():
            answer.set_exception(TimeoutError())

    async def watch(
        self,
        resource: Resource,
        namespace: str | None = None,
        *,
        version: str,
        labels: str | None = None,
        fields: str | None = None,
        lifetime: int = 300,
    ) -> AsyncIterator[tuple[str, Object]]:
        network, plural = self._network, resource.plural
        chosen, history = selecting(labels, fields), network.server.history[plural]
        at = network.server.since(plural, int(version))
        while True:
            while at == len(history) and (self._process, plural) not in network.half_open:
                await network.wait(plural)
            if (given_up := network.half_open.get((self._process, plural))) is not None:
                try:
                    await asyncio.sleep(given_up - network.loop.time())
                finally:  # also if the client gives it up earlier
                    network.half_open.pop((self._process, plural), None)
                raise aiohttp.ClientOSError("timed out")
            last, lag = len(history), network.choices.random() < network.weather.lag
            await asyncio.sleep(network.delay() if not lag else network.choices.random() * 6)
            while self._process in network.cut_off:
                await asyncio.sleep(1)
            if network.choices.random() < network.weather.broken:
                how = network.choices.choice([None, Expired(), aiohttp.ClientPayloadError("broken")])
                network.noted(f"{self._process}: the watch of {plural} ends: {how!r}")
                if how is None:
                    return
                raise how
            if network.choices.random() < 0.5:
                last = len(history)  # what has come meanwhile comes with it
            while at < last:
                event = history[at]
                at += 1
                if (found := watch_event(event, chosen)) is not None:
                    yield found
