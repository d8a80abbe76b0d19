"""Real ROS 2 nodes for the tests, one process each: ``python nodes.py ROLE ...``. Says ``ready`` and runs until killed.

publish TOPIC RATE [BYTES]    std_msgs/String, best effort and reliable readers match
robot TOPIC SERVICE ACTION    subscribes, serves, and calls: every reader that an output can have on a robot's side
call SERVICE ACTION           a client of a std_srvs/Trigger service and of a Fibonacci action
work ACTION                   test_msgs/Fibonacci action server, with a goal from a client of its own that is worked on
                              until a line is read: "succeed" ends the goal, any other one the server, but for lists of
                              numbers, which are fed back
look TOPIC SERVICE            what a node sees of them that neither publishes, nor subscribes, nor calls; prints it as JSON
say TOPIC TYPE                messages of any type, 20 a second, with the fields of the last line of JSON that was read
log NODE                      logs each line that is read, which begins with the level, such as "error no way out"
parameters NODE [SPEED]       a node with parameters: a double speed, a text label, an integer count, a list, and one that is unset
pose TOPIC X RATE [latched]   geometry_msgs/PoseWithCovarianceStamped at x = X; a rate of 0 says it once
capture JSON                  Capturing, told by JSON what to take, who the instances are, and which are in control in
                              turn, as soon as all that is published was seen; prints the poses that it took as JSON
obey TOPIC JSON               a robot's reader of std_msgs/String: told by JSON who the instances are (IP by name), prints
                              the name of the sender of each sample, as they come
watch SECONDS JSON            Watching, told by JSON what to watch (publishing hosts by topic), who the instances are,
                              and which are in control in turn; prints what it saw as JSON
"""

from __future__ import annotations

import json
import sys
import time


def publish(topic: str, rate: str, size: str = "1") -> None:
    import rclpy
    from rclpy.node import Node
    from std_msgs.msg import String

    rclpy.init()
    node = Node("publisher")
    publisher = node.create_publisher(String, topic, 10)
    message = String(data="x" * int(size))
    print("ready", flush=True)
    due = time.monotonic()
    while True:
        publisher.publish(message)
        due += 1 / float(rate)
        time.sleep(max(0.0, due - time.monotonic()))


def say(topic: str, type_name: str) -> None:
    import threading

    import rclpy
    from rclpy.node import Node

    from understudy.ros.runtime.interface_types import message_class
    from understudy.ros.runtime.message_values import to_message

    rclpy.init()
    node, cls = Node(f"say{time.time_ns()}"), message_class(type_name)
    publisher = node.create_publisher(cls, topic, 10)
    messages: list[str] = []
    threading.Thread(target=lambda: messages.extend(sys.stdin), daemon=True).start()
    print("ready", flush=True)
    while True:
        if messages:
            publisher.publish(to_message(cls, json.loads(messages[-1])))
        time.sleep(0.05)


def log(name: str) -> None:
    import rclpy

    rclpy.init()
    node = rclpy.create_node(name)
    logger = node.get_logger()
    print("ready", flush=True)
    for line in sys.stdin:
        level, _, text = line.strip().partition(" ")
        # rclpy remembers the level of a call by its place in the source.
        {
            "info": lambda text: logger.info(text),
            "warn": lambda text: logger.warning(text),
            "error": lambda text: logger.error(text),
        }[level](text)


def parameters(name: str, speed: str = "1.0") -> None:
    import rclpy
    from rclpy.parameter import Parameter

    rclpy.init()
    node = rclpy.create_node(name.strip("/"))
    for parameter, value in (("speed", float(speed)), ("label", "a"), ("count", 1), ("list", [1.0, 2.0])):
        node.declare_parameter(parameter, value)
    node.declare_parameter("unset", Parameter.Type.DOUBLE)
    print("ready", flush=True)
    rclpy.spin(node)


def pose(topic: str, x: str, rate: str, latched: str = "") -> None:
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile

    rclpy.init()
    node = Node(f"pose{abs(hash(topic + x))}")
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    publisher = node.create_publisher(PoseWithCovarianceStamped, topic, QoSProfile(depth=1, durability=durability))
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    message.pose.pose.position.x = float(x)
    publisher.publish(message)
    print("ready", flush=True)
    while True:
        time.sleep(1 / float(rate) if float(rate) else 60.0)
        if float(rate):
            publisher.publish(message)


def capture(text: str) -> None:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.serialization import deserialize_message

    from understudy.ros.observe.state_samples import StateSamples
    from understudy.ros.runtime.graph_node import Graph

    wish = json.loads(text)
    capturing = StateSamples(Graph("capturer"))
    capturing.follow(dict.fromkeys(wish["topics"], None))
    samples: list[list[object]] = []

    def drain() -> None:
        for message in capturing.drain():
            x = deserialize_message(message.data, PoseWithCovarianceStamped).pose.pose.position.x
            samples.append([message.topic, x, message.standing])

    print("ready", flush=True)
    results = []
    for active in wish["active"]:
        samples.clear()
        capturing.attribute(wish["instances"], active)
        end = time.monotonic() + 20
        while not all(any(topic == s[0] and x == s[1] for s in samples) for topic, x in wish["expect"][active]):
            assert time.monotonic() < end, f"{active}: {samples}"
            drain()
            time.sleep(0.02)
        end = time.monotonic() + 1.0
        while time.monotonic() < end:  # whatever else would come by mistake
            drain()
            time.sleep(0.02)
        results.append(list(samples))
    print(json.dumps(results), flush=True)


def robot(topic: str, service: str, action: str) -> None:
    import rclpy
    from rclpy.action import ActionClient, ActionServer
    from rclpy.node import Node
    from std_msgs.msg import String
    from std_srvs.srv import Trigger
    from test_msgs.action import Fibonacci

    rclpy.init()
    node = Node("robot")
    kept = [
        node.create_subscription(String, topic, lambda message: None, 10),
        node.create_service(Trigger, service, lambda request, response: response),
        node.create_client(Trigger, service),
        ActionServer(node, Fibonacci, action, lambda goal: Fibonacci.Result()),
        ActionClient(node, Fibonacci, action),
    ]
    print("ready", flush=True)
    rclpy.spin(node)
    del kept


def call(service: str, action: str) -> None:
    import rclpy
    from rclpy.action import ActionClient
    from rclpy.node import Node
    from std_srvs.srv import Trigger
    from test_msgs.action import Fibonacci

    rclpy.init()
    node = Node("caller")
    kept = [node.create_client(Trigger, service), ActionClient(node, Fibonacci, action)]
    print("ready", flush=True)
    rclpy.spin(node)
    del kept


def work(action: str) -> None:
    import threading

    import rclpy
    from rclpy.action import ActionClient, ActionServer
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.node import Node
    from test_msgs.action import Fibonacci

    rclpy.init()
    node = Node("worker")
    done = threading.Event()
    goals = []

    def execute(goal):
        goals.append(goal)
        done.wait()
        goal.succeed()
        return Fibonacci.Result()

    server = ActionServer(node, Fibonacci, action, execute)
    client = ActionClient(node, Fibonacci, action)
    executor = MultiThreadedExecutor(3)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    assert client.wait_for_server(20)
    client.send_goal_async(Fibonacci.Goal(order=1))
    print("ready", flush=True)
    while (line := sys.stdin.readline()).startswith("["):
        while not goals:
            time.sleep(0.01)
        goals[0].publish_feedback(Fibonacci.Feedback(sequence=json.loads(line)))
    if line == "succeed\n":
        done.set()
        sys.stdin.readline()
    done.set()
    executor.shutdown()
    server.destroy()
    client.destroy()
    node.destroy_node()
    rclpy.shutdown()


def obey(topic: str, text: str) -> None:
    from understudy.ros.observe.sample_sources import Sources
    from understudy.ros.runtime.graph_node import Graph
    from understudy.ros.runtime.sample_taking import SampleTaker

    sources, taker = Sources(json.loads(text)), SampleTaker()
    subscription = Graph("robot").subscribe(topic, "std_msgs/msg/String", depth=100)
    print("ready", flush=True)
    while True:
        with subscription.handle:
            while (sample := taker.take(subscription.handle.pointer, with_data=False)) is not None:
                print(sources.pod(sample.gid), flush=True)
        time.sleep(0.01)


def watch(duration: str, text: str) -> None:
    from understudy.ros.observe.topic_watch import TopicWatch
    from understudy.ros.runtime.graph_node import Graph
    from understudy.trees.core.health_tree import WatchedTopic

    wish = json.loads(text)
    graph = Graph("watcher")
    watching = TopicWatch(graph)
    watching.follow(WatchedTopic(name, "std_msgs/msg/String", 1.0, None) for name in wish["topics"])
    instances, active = wish["instances"], wish["active"]
    watching.attribute(instances, active[0])
    print("ready", flush=True)
    end = time.monotonic() + 20  # discovery may need a second round of announcements
    while any(len(watching.records(name)) < count for name, count in wish["topics"].items()):
        assert time.monotonic() < end, "the publishers were not found"
        watching.drain()
        time.sleep(0.05)
    samples = []
    for pod in active:
        watching.attribute(instances, pod)
        switched = time.time()
        while time.time() < switched + float(duration):
            watching.drain()
            time.sleep(0.05)
        now = time.time()
        samples.append(
            {
                "counted": {name: watching.topic(name).count for name in wish["topics"]},
                "first": {
                    name: {other: watching.first_from(name, other, since=switched) for other in instances}
                    for name in wish["topics"]
                },
                "last": {
                    name: {other: watching.last_from(name, other) for other in instances} for name in wish["topics"]
                },
                "others": {name: watching.last_from_others(name, pod) for name in wish["topics"]},
                "hosts": {
                    name: {host.hex(): [record.count, record.lost] for host, record in watching.records(name).items()}
                    for name in wish["topics"]
                },
                "problems": list(watching.sources.problems()),
                "switched": switched,
                "now": now,
            }
        )
    print(json.dumps(samples), flush=True)


def look(topic: str, service: str) -> None:
    from understudy.api.kinds.robot_workload import Output
    from understudy.ros.runtime.graph_node import Graph

    graph = Graph("looker")
    print("ready", flush=True)
    end = time.monotonic() + 20
    while True:
        found = {
            "type": graph.type_of(topic),
            "endpoints": len(graph.endpoints(Output(service=service, type="std_srvs/srv/Trigger"))),
        }
        if all(found.values()) or time.monotonic() > end:
            break
        time.sleep(0.05)
    time.sleep(0.5)
    found["endpoints"] = len(graph.endpoints(Output(service=service, type="std_srvs/srv/Trigger")))
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    {
        "call": call,
        "capture": capture,
        "log": log,
        "look": look,
        "obey": obey,
        "parameters": parameters,
        "pose": pose,
        "publish": publish,
        "robot": robot,
        "say": say,
        "watch": watch,
        "work": work,
    }[sys.argv[1]](*sys.argv[2:])
