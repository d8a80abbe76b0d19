"""Calls services, lifecycle transitions and parameters of one instance, and publishes to it, from inside its pod.

The calls go through a node of their own in the process's participant (calling_node.py), which exists only while it is
used. Every call has a bound in seconds. A call that fails has a message that names the node, service or topic.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from understudy.ros.actions.calling_node import CallingNode, GraphLocation
from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.interface_types import TypeNotInstalled, interface_class, message_class
from understudy.ros.runtime.lean_imports import rclpy_imported
from understudy.ros.runtime.message_values import MessageError, to_mapping, to_message

if TYPE_CHECKING:
    from understudy.ros.runtime.sample_taking import Sample

IDLE = 60.0
"""Seconds without a call after which the node is closed."""

LINGER = 5.0
"""Seconds for which a message is still sent again, after the call has returned, to subscribers that may have lost
it."""

OFFERED_WITHIN = 0.5
"""Seconds within which the services of a node must be discovered after its subscription; not every node has any."""

CHECK_PERIOD = 0.02
"""Seconds between two reads of the graph or a queue during a wait."""

ASK_AGAIN = 0.5
"""Seconds between two requests for a lifecycle state during a transition, since the answer to the transition may get
lost."""

REPEAT = 1.0
"""Seconds without an answer after which a request that can be repeated is repeated: a server that has not discovered a
new client yet drops its answer (rmw_fastrtps waits 100 ms for it)."""

MOST_REPEATS = 20
"""Requests of one kind that may wait for their answers."""

ANSWER_LOST = 3.0
"""Seconds at rest in the old state after which a transition without an answer counts as refused."""

TRANSITIONS: Mapping[tuple[str, str], tuple[str, int, str]] = {
    ("unconfigured", "inactive"): ("configure", 1, "inactive"),
    ("unconfigured", "active"): ("configure", 1, "inactive"),
    ("unconfigured", "finalized"): ("shutdown", 5, "finalized"),
    ("inactive", "active"): ("activate", 3, "active"),
    ("inactive", "unconfigured"): ("cleanup", 2, "unconfigured"),
    ("inactive", "finalized"): ("shutdown", 6, "finalized"),
    ("active", "inactive"): ("deactivate", 4, "inactive"),
    ("active", "unconfigured"): ("deactivate", 4, "inactive"),
    ("active", "finalized"): ("shutdown", 7, "finalized"),
}
"""The next transition on the way from one state to another: its name, its id (lifecycle_msgs) and the state after
it."""

STATES = ("unconfigured", "inactive", "active", "finalized")
"""The states in which a managed node can rest."""


class CallFailed(Exception):
    """A call that did not succeed. The text says why."""


class _CallProgress:
    """One call in progress."""

    def __init__(self, missing: str) -> None:
        self.missing = missing
        """What the call waits for, for the message at its timeout."""
        self.sent = False
        """Whether a request was sent and waits for its answer."""


class Listener:
    """Provides the messages of a topic from now on."""

    def __init__(self, subscription: Any) -> None:
        from understudy.ros.runtime.sample_taking import SampleTaker

        self._subscription, self._taker = subscription, SampleTaker()
        self._last: Sample | None = None

    @property
    def last(self) -> Sample | None:
        """The latest message; None before the first."""
        with self._subscription.handle:
            while (sample := self._taker.take(self._subscription.handle.pointer)) is not None:
                self._last = sample
        return self._last

    async def first(self, within: float) -> Sample | None:
        """Wait for the first message, for at most ``within`` seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within):
                await _until(lambda: self.last is not None)
        return self._last


class InstanceCaller:
    """One instance's services, parameters, lifecycle and topics. For one event loop."""

    def __init__(self, name: str, *, place: Callable[[], GraphLocation | None] | None = None) -> None:
        """``name`` is that of the node, which is created at the first call.

        ``place`` returns its location, None while that is not known yet. Without ``place`` the node joins the graph
        that the process's environment names.
        """
        self._name, self._place = name, place
        self._opened: CallingNode | None = None
        self._users = 0
        self._idle: asyncio.TimerHandle | None = None

    # -- services ---------------------------------------------------------------------------------------------------

    async def call(
        self, service: str, type_name: str, request: Mapping[str, Any], within: float, *, repeat: float | None = None
    ) -> dict[str, Any]:
        """Return the answer of a service (``package/srv/Name``), waiting for the service too. Raises CallFailed.

        With ``repeat``, the request is repeated after that number of seconds without an answer, as often as necessary.
        """
        async with self._bound(f"service {service}", within) as (opened, bound):
            return to_mapping(await _asked(opened, bound, service, type_name, request, repeat=repeat))

    async def service_present(self, service: str) -> bool:
        """Return whether a server of the service is here now. Raises CallFailed."""
        async with self._bound(f"service {service}", 10.0) as (opened, _):
            return opened.serves(service)

    async def node_present(self, node: str) -> bool:
        """Return whether a node of this full name is here now. Raises CallFailed."""
        async with self._bound(f"node {node}", 10.0) as (opened, _):
            return opened.has_node(node)

    # -- lifecycle --------------------------------------------------------------------------------------------------

    async def lifecycle_state(self, node: str, within: float) -> str:
        """Return the state of a managed node: unconfigured, inactive, active or finalized, or a state in transition.

        Raises CallFailed.
        """
        async with self._bound(f"node {node}", within) as (opened, bound):
            return await _state(opened, bound, node)

    async def bring_to(self, node: str, state: str, within: float) -> None:
        """Bring a managed node to a state in which it can rest, by the shortest transitions.

        Does nothing if the node is in that state already. Raises CallFailed.
        """
        if state not in STATES:
            raise CallFailed(f"node {node}: {state!r} is not a state to bring it to: take one of {', '.join(STATES)}")
        async with self._bound(f"node {node}", within) as (opened, bound):
            while (present := await _state(opened, bound, node)) != state:
                step = TRANSITIONS.get((present, state))
                if step is not None:
                    await _transition(opened, bound, node, present, *step)
                elif present in STATES:
                    raise CallFailed(
                        f"node {node} is {present}, and no lifecycle transition leads from there to {state}"
                    )
                else:
                    bound.missing = f"node {node} is still {present}, not yet {state}"
                    await asyncio.sleep(CHECK_PERIOD)

    # -- parameters -------------------------------------------------------------------------------------------------

    async def get_parameters(self, node: str, names: Sequence[str], within: float) -> dict[str, Any]:
        """Return values of a node's parameters. Raises CallFailed, also if the node lacks one of them."""
        async with self._bound(f"node {node}", within) as (opened, bound):
            return await _parameters(opened, bound, node, names)

    async def set_parameters(self, node: str, values: Mapping[str, Any], within: float) -> None:
        """Set parameters of a node. An integer is converted if the parameter is a double.

        Raises CallFailed with the node's reason if it refuses one.
        """
        async with self._bound(f"node {node}", within) as (opened, bound):
            from rclpy.parameter import Parameter

            whole = [name for name, value in values.items() if _is_whole(value)]
            present = await _parameters(opened, bound, node, whole) if whole else {}
            wanted = {name: _as_real(value) if _is_real(present.get(name)) else value for name, value in values.items()}
            try:
                parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in wanted.items()]
            except (AssertionError, TypeError) as error:
                raise CallFailed(f"node {node}: {dict(values)!r:.200} cannot be parameters: {error}") from error
            answer = await _asked(
                opened,
                bound,
                f"{node}/set_parameters",
                "rcl_interfaces/srv/SetParameters",
                {"parameters": parameters},
                repeat=REPEAT,
            )
            refused = [
                f"{name} = {value!r}: {result.reason or 'no reason given'}"
                for (name, value), result in zip(wanted.items(), answer.results, strict=True)
                if not result.successful
            ]
            if refused:
                raise CallFailed(f"node {node} refused parameters: {'; '.join(refused)}")

    # -- topics -----------------------------------------------------------------------------------------------------

    async def publish(
        self,
        topic: str,
        type_name: str,
        message: Mapping[str, Any] | bytes | Callable[[], bytes],
        within: float,
        count: int = 1,
        *,
        answered: bool = False,
    ) -> None:
        """Publish a message ``count`` times, and wait until the subscribers have received it. Raises CallFailed.

        The first message is sent once somebody here subscribes to the topic. A message in bytes is CDR with its header;
        a function is called for the bytes at the last moment.

        Instances of one workload match each other's subscribers and cannot reach them, and the middleware does not
        report whose acknowledgement is missing. So if there are subscribers elsewhere, also of a process that has just
        ended, the message is sent repeatedly for a while, without waiting. With ``answered``, the nodes here that
        subscribe must have answered a request since then: otherwise a process that is stopped, or has not discovered
        the publisher yet, would count as one that has received the message.
        """
        async with self._bound(f"topic {topic}", within) as (opened, bound):
            cls = message_class(type_name)
            wire = to_message(cls, message) if isinstance(message, Mapping) else message
            publisher = opened.publisher(cls, topic, count)
            elsewhere = False
            try:
                bound.missing = f"nobody subscribes to {topic} as {type_name}"
                await _until(lambda: opened.is_read(publisher, topic, type_name))
                for _ in range(count):
                    publisher.publish(wire() if callable(wire) else wire)
                bound.missing = f"the subscribers of {topic} have not taken the message"
                while True:
                    elsewhere = opened.is_read_elsewhere(publisher, topic, type_name)
                    if elsewhere and answered and await _answer(opened, bound, topic, type_name):
                        break
                    if await asyncio.to_thread(_acknowledged, publisher):
                        elsewhere = False
                        break
                    if elsewhere:
                        break
            finally:
                lingers = LINGER if elsewhere else 0.0
                asyncio.get_running_loop().call_later(lingers, opened.node.destroy_publisher, publisher)

    async def topic_type(self, topic: str, within: float) -> str:
        """Return the type that the publishers of a topic announce, waiting for one that is here. Raises CallFailed."""
        async with self._bound(f"topic {topic}", within) as (opened, bound):
            bound.missing = f"nobody publishes {topic}"
            found: set[str] = set()

            def known() -> bool:
                found.update(opened.published_types(topic))
                return bool(found)

            await _until(known)
            if len(found) > 1:
                raise CallFailed(f"the publishers of {topic} disagree about its type: {', '.join(sorted(found))}")
            return found.pop()

    async def wait_sample(
        self, topic: str, type_name: str, within: float, since: float | None = None, *, own: bool = False
    ) -> Sample:
        """Return the next message of a topic, or a latched one that exists already. Raises CallFailed.

        With ``since``, the message was not written before that time (Unix seconds, by the writer's clock). With
        ``own``, it is from a writer on this host.
        """
        async with self._bound(f"topic {topic}", within) as (opened, bound):
            from understudy.ros.runtime.sample_taking import SampleTaker

            cls, taker, host = message_class(type_name), SampleTaker(), opened.host if own else None
            bound.missing = f"nothing {'of this instance ' if host else ''}came on {topic} ({type_name})"
            # A reader of latched messages does not match a writer that keeps none, and the other reader does not
            # receive latched ones.
            subscriptions = [opened.subscription(cls, topic, latched=latched) for latched in (False, True)]
            try:
                while True:
                    for subscription in subscriptions:
                        with subscription.handle:
                            while (sample := taker.take(subscription.handle.pointer)) is not None:
                                known = host is None or MIDDLEWARE.host_of(sample.gid) == host
                                if known and (since is None or sample.sent >= since):
                                    return sample
                    await asyncio.sleep(CHECK_PERIOD)
            finally:
                for subscription in subscriptions:
                    opened.node.destroy_subscription(subscription)

    @contextlib.asynccontextmanager
    async def listening(self, topic: str, type_name: str, within: float) -> AsyncIterator[Listener]:
        """Provide a topic's messages as they arrive, for as long as the context lasts.

        It starts within ``within`` seconds. Raises CallFailed.
        """
        self._users += 1
        try:
            async with self._bound(f"topic {topic}", within) as (opened, _):
                subscription = opened.subscription(message_class(type_name), topic, latched=False)
            try:
                yield Listener(subscription)
            finally:
                opened.node.destroy_subscription(subscription)
        finally:
            self._left()

    # -- the node ---------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """End the node, if there is one. The next call creates another."""
        self._stay()
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _stay(self) -> None:
        """Cancel the closing of an idle node."""
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None

    def _open(self) -> CallingNode | None:
        """Return the node at the present location; None if that is not known yet."""
        place = self._place() if self._place is not None else None
        if self._place is not None and place is None:
            return None
        if self._opened is not None and not self._opened.is_at(place):
            self._opened.close()
            self._opened = None
        if self._opened is None:
            self._opened = CallingNode(self._name, place)
        return self._opened

    @contextlib.asynccontextmanager
    async def _bound(self, what: str, within: float) -> AsyncIterator[tuple[CallingNode, _CallProgress]]:
        """Provide the node, for at most ``within`` seconds. ``what`` names the other side in messages."""
        bound = _CallProgress("this process has not joined the ROS graph")
        self._users += 1
        self._stay()
        try:
            async with asyncio.timeout(within):
                await rclpy_imported()
                await _until(lambda: self._open() is not None)
                assert self._opened is not None, "it was waited for"
                yield self._opened, bound
        except TimeoutError:
            raise CallFailed(f"{bound.missing} within {within:.3g} s") from None
        except (TypeNotInstalled, MessageError, ValueError) as error:
            raise CallFailed(f"{what}: {error}") from error
        except Exception as error:
            if not _is_of_a_closed_node(error):
                raise
            raise CallFailed(f"{what}: this process left the ROS graph during the call") from error
        finally:
            self._left()

    def _left(self) -> None:
        """Count one user less. After the last one, the node closes after a while."""
        self._users -= 1
        if not self._users and self._opened is not None:
            self._idle = asyncio.get_running_loop().call_later(IDLE, self.close)


def _is_of_a_closed_node(error: Exception) -> bool:
    """Whether an error shows that an entity was used after its node was closed, as when the process joins another graph."""
    from rclpy.exceptions import InvalidHandle

    return isinstance(error, InvalidHandle)


def _acknowledged(publisher: Any) -> bool:
    """Return whether every reliable subscriber has received all messages; waits a moment for that."""
    from rclpy.duration import Duration

    return bool(publisher.wait_for_all_acked(Duration(seconds=0.2)))


async def _answer(opened: CallingNode, bound: _CallProgress, topic: str, type_name: str) -> bool:
    """Wait until the nodes here that subscribe to a topic have answered a request. Return False if none of them offers parameters."""

    def services() -> dict[str, str]:
        return {f"{node}/get_parameters": node for node in opened.subscribers(topic, type_name)}

    bound.missing = f"a message was sent on {topic}, and a node that subscribes to it has not announced its name"
    await _until(lambda: "" not in opened.subscribers(topic, type_name))
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(OFFERED_WITHIN):
            await _until(lambda: all(map(opened.serves, services())))
    offered = {service: node for service, node in services().items() if opened.serves(service)}
    for service, node in offered.items():
        bound.missing = f"a message was sent on {topic}, and node {node} has not answered since then"
        await _asked(opened, _CallProgress(""), service, "rcl_interfaces/srv/GetParameters", {}, repeat=REPEAT)
    return bool(offered)


async def _until(holds: Callable[[], bool]) -> None:
    while not holds():  # noqa: ASYNC110 - the graph has no event for it
        await asyncio.sleep(CHECK_PERIOD)


async def _asked(
    opened: CallingNode,
    bound: _CallProgress,
    service: str,
    type_name: str,
    request: Mapping[str, Any],
    *,
    repeat: float | None = None,
) -> Any:
    """Return the answer of a service, as a message.

    ``repeat`` is the number of seconds after which a request that may be carried out twice is repeated. The function
    waits until both sides of the service match its client. Whether the server has matched the client is not visible
    from here, and a server that has not drops its answer.
    """
    client = await opened.client(service, type_name)
    message = to_message(interface_class(type_name).Request, request)
    bound.missing = f"service {service} ({type_name}) is not there"
    await _until(lambda: opened.serves(service) and client.ready())
    bound.missing, bound.sent = f"service {service} has not answered", True
    if repeat is None:
        return await client.call(message)
    asked: set[asyncio.Task[Any]] = set()
    try:
        while True:
            if len(asked) < MOST_REPEATS:
                asked.add(asyncio.create_task(client.call(message)))
            done, _ = await asyncio.wait(asked, timeout=repeat, return_when=asyncio.FIRST_COMPLETED)
            if done:
                return done.pop().result()
    finally:
        for task in asked:
            task.cancel()
        await asyncio.gather(*asked, return_exceptions=True)


# -- lifecycle ------------------------------------------------------------------------------------------------------


async def _state(opened: CallingNode, bound: _CallProgress, node: str) -> str:
    answer = await _asked(opened, bound, f"{node}/get_state", "lifecycle_msgs/srv/GetState", {}, repeat=REPEAT)
    return str(answer.current_state.label)


async def _transition(
    opened: CallingNode, bound: _CallProgress, node: str, present: str, transition: str, number: int, goal: str
) -> None:
    """Carry out one transition. Its answer may come late or get lost, so the state itself is also requested.

    Raises CallFailed if the node did not reach the state.
    """
    request = {"transition": {"id": number, "label": transition}}
    asking = _CallProgress("")
    ask = _asked(opened, asking, f"{node}/change_state", "lifecycle_msgs/srv/ChangeState", request)
    asked = asyncio.create_task(ask)
    rested: float | None = None
    try:
        while True:
            await asyncio.wait([asked], timeout=ASK_AGAIN)
            answered = asked.done()
            found = await _state(opened, bound, node)
            if found == goal:
                return
            bound.missing = f"node {node} is still {found} after the request to {transition}"
            if answered and found in STATES:
                break
            if found != present or not asking.sent:
                rested = None
            elif rested is None:
                rested = time.monotonic()
            elif time.monotonic() - rested > ANSWER_LOST:
                break
    finally:
        asked.cancel()
        await asyncio.gather(asked, return_exceptions=True)
    raise CallFailed(f"node {node} did not {transition}: it is {found} (see its log)")


# -- parameters -----------------------------------------------------------------------------------------------------


async def _parameters(opened: CallingNode, bound: _CallProgress, node: str, names: Sequence[str]) -> dict[str, Any]:
    from rclpy.parameter import parameter_value_to_python

    service, type_name = f"{node}/get_parameters", "rcl_interfaces/srv/GetParameters"
    answer = await _asked(opened, bound, service, type_name, {"names": list(names)}, repeat=REPEAT)
    values = [parameter_value_to_python(value) for value in answer.values]
    if len(values) == len(names) and None not in values:
        return {name: _plain(value) for name, value in zip(names, values, strict=True)}
    if len(names) > 1:  # a node that lacks one of them sends no answer at all
        found: dict[str, Any] = {}
        for name in names:
            found |= await _parameters(opened, bound, node, [name])
        return found
    raise CallFailed(f"node {node} has no parameter {names[0]}")


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


def _is_whole(value: object) -> bool:
    if isinstance(value, list):
        return bool(value) and all(map(_is_whole, value))
    return isinstance(value, int) and not isinstance(value, bool)


def _is_real(value: object) -> bool:
    return isinstance(value[0], float) if isinstance(value, list) and value else isinstance(value, float)


def _as_real(value: Any) -> Any:
    return [float(item) for item in value] if isinstance(value, list) else float(value)
