"""The XML profiles of the robot's side and of the instances.

On the robot's side each gated reader has its own UDP port. A gate can distinguish ports: closing them closes exactly
the outputs of a standby, and leaves discovery, acknowledgements and everything that it receives open.

In an instance, the endpoints of tasks are in a DDS partition of the pod. Clients of the instance see only the server of
the task proxy, and only the agent in the pod reaches what the instance serves.

The commands of an instance expire, so that a standby does not deliver old ones when the gate opens for it (see
command_lifespan.py).

With the reflex, the readers of outputs on the robot's side choose among the writers of the instances (see
exclusive_ownership.py).

Fast DDS selects the profile of an endpoint by the name of its DDS topic, so the application's source does not change.

This module imports no ROS, because the operator writes these profiles.
"""

from __future__ import annotations

from collections.abc import Iterable
from xml.sax.saxutils import quoteattr

from understudy.api import names
from understudy.api.kinds.robot_workload import Output, Reflex
from understudy.api.kinds.task_spec import Task
from understudy.ros.dds import command_lifespan, exclusive_ownership

_ACTION_SERVICES = ("send_goal", "get_result", "cancel_goal")
_ACTION_COMMANDS = ("send_goal", "cancel_goal")
_ACTION_TOPICS = ("feedback", "status")

PARTITIONS = "understudy-"
"""Prefix of the partitions of pods. Their names follow."""

PARTITION = f"{PARTITIONS}${{{names.POD_VARIABLE}}}"
"""The partition of a pod's tasks, and with a mux of its outputs. Fast DDS replaces the variable from the environment of the process that
reads the file."""


def reader_profiles(output: Output) -> list[str]:
    """Return the profile names of all readers that an output can have on the robot's side.

    A service or an action may be served by the robot or called by it, so both directions are named: a request reader
    (``rq/``) exists in a server, a reply reader (``rr/``) in a client. The names are the DDS topic names of
    rmw_fastrtps without the ``rt`` prefix of topics; services have no leading slash.
    """
    if output.topic:
        return [output.topic]
    if output.service:
        return _service_readers(output.service)
    if output.action:
        hidden = f"{output.action}/_action"
        services = [reader for name in _ACTION_SERVICES for reader in _service_readers(f"{hidden}/{name}")]
        return services + [f"{hidden}/{name}" for name in _ACTION_TOPICS]
    raise ValueError("an output names neither a topic, nor a service, nor an action")


def _service_readers(service: str) -> list[str]:
    return [f"rq{service}Request", f"rr{service}Reply"]


def gate_ports(outputs: Iterable[Output]) -> dict[str, int]:
    """Return the UDP port of each gated reader by profile name, in the order of the outputs.

    Each reader has its own port: of two readers in one network namespace with the same port, the second receives
    nothing. The operator, the robot and the monitor must compute the same ports, so the ports depend on the outputs
    only.

    Raises ValueError, naming the output, if the gated range (:data:`names.GATE_PORTS`) is exhausted.
    """
    ports: dict[str, int] = {}
    free = iter(names.GATE_PORTS)
    for output in outputs:
        for profile in reader_profiles(output):
            if profile in ports:
                continue
            port = next(free, None)
            if port is None:
                raise ValueError(
                    f"spec.outputs: no gate port is left for {output.name}: the gate has {len(names.GATE_PORTS)} UDP ports; a topic "
                    "takes 1, a service 2, an action 8. Remove an output"
                )
            ports[profile] = port
    return ports


def profiles_xml(outputs: Iterable[Output], reflex: Reflex | None = None) -> str:
    """Return the profile file for FASTRTPS_DEFAULT_PROFILES_FILE, for the robot's nodes and the monitor.

    The locators name a port and no address, so that Fast DDS announces it for every interface. Of the QoS, only
    ownership and deadline are set, for topics with the reflex: rmw_fastrtps overwrites the rest with the node's own
    settings.

    Raises ValueError as :func:`gate_ports` does.
    """
    outputs = list(outputs)
    exclusive = {output.topic for output in outputs if output.topic} if reflex else set()
    readers = "".join(
        _READER.format(
            name=quoteattr(name),
            qos=exclusive_ownership.robot_reader(reflex) if reflex and name in exclusive else "",
            port=port,
        )
        for name, port in gate_ports(outputs).items()
    )
    return _FILE.format(profiles=readers)


def command_writers(output: Output) -> list[str]:
    """Return the profile names of the writers in an instance whose samples command the robot.

    These are a topic, the requests of a service, and the goals and cancellations of an action. Replies answer a request
    of the robot.
    """
    if output.topic:
        return [output.topic]
    services = [output.service] if output.service else [f"{output.action}/_action/{name}" for name in _ACTION_COMMANDS]
    return [f"rq{service}Request" for service in services]


def instance_profiles_xml(tasks: Iterable[Task], outputs: Iterable[Output] = (), reflex: Reflex | None = None) -> str:
    """Return the profile file for the processes of an instance and its agent; empty if they need none.

    rmw_fastrtps keeps the partition that a profile sets, for readers and writers both, and ownership and lifespan too.
    Values that differ between pods remain variables (see agent/prepare.py).
    """
    profiles = "".join(
        _partitioned(kind, name, PARTITION)
        for task in tasks
        for name in _action_endpoints(task.action)
        for kind in _KINDS
    )
    for output in outputs:
        length = output.valid_for(reflex)
        qos, times = command_lifespan.writer_qos(length), command_lifespan.writer_times(length)
        if output.topic and reflex is not None:
            qos = exclusive_ownership.instance_writer(reflex) + qos
            reader = exclusive_ownership.instance_reader()
            profiles += _INSTANCE.format(kind="data_reader", name=quoteattr(output.topic), qos=reader, times="")
        for name in command_writers(output):
            profiles += _INSTANCE.format(kind="data_writer", name=quoteattr(name), qos=qos, times=times)
    return _FILE.format(profiles=profiles) if profiles else ""


def instance_of(partitions: Iterable[str]) -> str:
    """Return the name of the pod whose partition a writer is in; empty if it is in none, or in others too."""
    found = list(partitions)
    return found[0].removeprefix(PARTITIONS) if len(found) == 1 and found[0].startswith(PARTITIONS) else ""


def muxed_profiles_xml(outputs: Iterable[Output], tasks: Iterable[Task] = ()) -> str:
    """Return the profile file of an instance whose outputs a mux forwards: all its writers are in the partition of the pod.

    So they cannot reach the robot's own readers or another instance, whatever the network is. Its readers are in that partition and in the
    default one: its processes hear each other and the robot. What is an output is heard from the instance itself only.
    """
    endpoints = [name for output in outputs for name in reader_profiles(output)]
    endpoints += [name for task in tasks for name in _action_endpoints(task.action)]
    profiles = _DEFAULT_WRITER.format(partition=PARTITION) + _DEFAULT_READER.format(partition=PARTITION)
    profiles += "".join(_partitioned(kind, name, PARTITION) for name in endpoints for kind in _KINDS)
    return _FILE.format(profiles=profiles)


def mux_monitor_profiles_xml(outputs: Iterable[Output]) -> str:
    """Return the profile file of the monitor of a robot with a mux: it hears the robot and all instances, and of outputs that are topics
    the instances alone, not what the mux makes of them."""
    everybody = f"{PARTITIONS}*"
    topics = [output.topic for output in outputs if output.topic]
    profiles = "".join(_partitioned("data_reader", topic, everybody) for topic in topics)
    return _FILE.format(profiles=_DEFAULT_READER.format(partition=everybody) + profiles)


def mux_profiles_xml(outputs: Iterable[Output]) -> str:
    """Return the profile file of a mux: toward the instances it is in the partitions of all pods, and toward the robot in the default one.

    Both sides use the same names. What comes from instances is read in their partitions and written in the default one. What the robot
    returns, such as replies and feedback, is read in the default one and written in their partitions.
    """
    everybody = f"{PARTITIONS}*"
    return _FILE.format(
        profiles=_SOON_DISCOVERED
        + "".join(
            _partitioned("data_reader" if is_command else "data_writer", name, everybody)
            for output in outputs
            for name, is_command in _directions(output)
        )
    )


def _directions(output: Output) -> list[tuple[str, bool]]:
    """Return the DDS topics of an output that the robot reads or serves, each with whether its samples are sent to the robot."""
    return [(name, bool(output.topic) or name.startswith("rq")) for name in reader_profiles(output)]


def _action_endpoints(action: str) -> list[str]:
    """Return the profile names of all readers and writers of an action's server and clients."""
    return reader_profiles(Output(action=action, type="action_msgs/action/Any"))


_KINDS = ("data_reader", "data_writer")


def _partitioned(kind: str, name: str, partition: str) -> str:
    return _PARTITIONED.format(kind=kind, name=quoteattr(name), partition=partition)


_SOON_DISCOVERED = """\
    <participant profile_name="soon_discovered" is_default_profile="true">
      <rtps>
        <builtin>
          <discovery_config>
            <clientAnnouncementPeriod>
              <sec>0</sec>
              <nanosec>100000000</nanosec>
            </clientAnnouncementPeriod>
          </discovery_config>
        </builtin>
      </rtps>
    </participant>
"""
"""Announces a client to its discovery server every 100 ms until that answers (450 ms by default). Nothing reaches the robot meanwhile."""

_FILE = """\
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com">
  <profiles>
{profiles}  </profiles>
</dds>
"""

_READER = """\
    <data_reader profile_name={name}>
      {qos}<unicastLocatorList><locator><udpv4><port>{port}</port></udpv4></locator></unicastLocatorList>
    </data_reader>
"""

_PARTITIONED = """\
    <{kind} profile_name={name}>
      <qos><partition><names><name>{partition}</name></names></partition></qos>
    </{kind}>
"""

_DEFAULT_WRITER = f"""\
    <data_writer profile_name="{names.APART_PROFILE}" is_default_profile="true">
      <qos><partition><names><name>{{partition}}</name></names></partition></qos>
    </data_writer>
"""

_DEFAULT_READER = """\
    <data_reader profile_name="understudy_reader" is_default_profile="true">
      <propertiesPolicy><properties><property>
        <name>partitions</name><value>;{partition}</value>
      </property></properties></propertiesPolicy>
    </data_reader>
"""
"""The readers without a profile of their own. The empty name before the semicolon is the default partition: a list of partitions in the QoS
cannot contain it, and this property of Fast DDS can."""

_INSTANCE = """\
    <{kind} profile_name={name}>
      <qos>{qos}</qos>{times}
    </{kind}>
"""
