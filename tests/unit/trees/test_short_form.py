"""Good trees load; of bad ones every problem is named, with its place and what would be right."""

import pytest

from tests.support.golden import assert_golden
from understudy.trees.languages.short.health_loader import Problem, TreeError, load

ROOT = "spec.monitoring.yaml"
KINDS = (
    "parallel, sequence, selector, inverter, while, topic, value, age, diagnostics, transform, publisher, node, log, "
    "progress, lifecycle, motion, parameter, pod"
)
RATES = "'> 8 Hz', '>= 8 Hz', '< 20 Hz', '<= 20 Hz' or '9 to 11 Hz'"

SCAN = {"topic": {"name": "/scan", "rate": "> 8 Hz"}}
CMD_VEL = {"topic": {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "gap": "500ms"}}


def problems(tree: object) -> list[str]:
    with pytest.raises(TreeError) as caught:
        load(tree)  # type: ignore[arg-type]
    return [str(problem) for problem in caught.value.problems]


def test_topics_contain_what_their_subscription_needs():
    tree = load({"parallel": [SCAN, CMD_VEL]})
    scan, cmd_vel = tree.topics
    assert (scan.name, scan.type, scan.window, scan.rate) == ("/scan", None, 2.0, 16.0)
    assert (cmd_vel.name, cmd_vel.type, cmd_vel.window, cmd_vel.rate) == (
        "/cmd_vel",
        "geometry_msgs/msg/Twist",
        0.0,
        None,
    )


def test_a_topic_of_two_leaves_is_watched_once_with_the_needs_of_both():
    slow = {
        "topic": {"name": "/scan", "type": "sensor_msgs/msg/LaserScan", "rate": "< 40 Hz", "window": "5s"},
        "name": "slow",
    }
    (topic,) = load({"sequence": [SCAN, slow]}).topics
    assert (topic.type, topic.window, topic.rate) == ("sensor_msgs/msg/LaserScan", 5.0, 40.0)


def test_the_path_of_a_leaf_consists_of_the_names_of_its_named_nodes():
    tree = load(
        {"parallel": [{"selector": [SCAN], "name": "sensors"}, {"inverter": CMD_VEL}, {**SCAN, "name": "again"}]}
    )
    leaves = [node.name for node in tree.root.iterate() if not node.children]
    assert leaves == ["sensors/scan", "cmd_vel", "again"]


LEAF = {"topic": {"name": "/cmd_vel", "gap": "500ms"}}


@pytest.mark.parametrize(
    ("tree", "place", "expected"),
    [
        ([], "", f"found a list; a node is a mapping with one of {KINDS}"),
        ({}, "", f"the node is empty; give one of {KINDS}"),
        ({"paralel": [SCAN]}, ".paralel", "unknown key 'paralel', did you mean 'parallel'?"),
        ({"parallel": []}, ".parallel", "the list is empty; parallel needs at least one node"),
        ({"parallel": SCAN}, ".parallel", "found a mapping; 'parallel' must have a list of nodes"),
        ({"parallel": [None]}, ".parallel[0]", f"found nothing; a node is a mapping with one of {KINDS}"),
        ({"parallel": [SCAN], **CMD_VEL}, "", "found parallel and topic in one node; give each a node of its own"),
        ({**SCAN, "gap": "1s"}, ".gap", "unknown key; gap belongs inside topic, transform or progress"),
        ({**SCAN, "name": "a/b"}, ".name", "found 'a/b'; a node's name is 1 to 63 letters, digits, '_', '-' and '.'"),
        ({"topic": "/scan"}, ".topic", "found '/scan'; 'topic' must be a mapping such as {name: /cmd_vel, gap: 500ms}"),
        ({"topic": {"gap": "1s"}}, ".topic.name", "missing; give the topic's fully qualified name, such as /cmd_vel"),
        ({"topic": {"name": "scan", "gap": "1s"}}, ".topic.name", "found 'scan'; did you mean '/scan'?"),
        (
            {"topic": {"name": 7, "gap": "1s"}},
            ".topic.name",
            "found 7; give a fully qualified topic name such as /cmd_vel",
        ),
        (
            {"topic": {"name": "/scan"}},
            ".topic",
            "neither gap nor rate is given; give gap, such as 500ms, or rate, such as '> 8 Hz'",
        ),
        (
            {"topic": {"name": "/scan", "gpa": "1s", "gap": "1s"}},
            ".topic.gpa",
            "unknown key 'gpa', did you mean 'gap'?",
        ),
        (
            {"topic": {"name": "/scan", "gap": 500}},
            ".topic.gap",
            "found 500, which has no unit; write it with ms, s, m or h, such as 500ms",
        ),
        (
            {"topic": {"name": "/scan", "gap": "500us"}},
            ".topic.gap",
            "'500us' is not a duration: write a number with ms, s, m or h, such as 500ms or 1m30s",
        ),
        ({"topic": {"name": "/scan", "gap": "0s"}}, ".topic.gap", "found '0s'; it must be longer than 0"),
        ({"topic": {"name": "/scan", "gap": "25h"}}, ".topic.gap", "found '25h'; it must be at most 24h"),
        (
            {"topic": {"name": "/scan", "gap": "1s", "window": "2s"}},
            ".topic.window",
            "a window is only for a rate; give rate, or remove window",
        ),
        ({"topic": {"name": "/scan", "rate": "> 8"}}, ".topic.rate", f"'> 8' is not a rate: write {RATES}"),
        ({"topic": {"name": "/scan", "rate": 8}}, ".topic.rate", f"found 8; write {RATES}"),
        (
            {"topic": {"name": "/scan", "rate": "11 to 9 Hz"}},
            ".topic.rate",
            "no rate is within '11 to 9 Hz': write the lower bound first, such as '9 to 11 Hz'",
        ),
        (
            {"topic": {"name": "/scan", "rate": "> 0 Hz"}},
            ".topic.rate",
            "'> 0 Hz' sets no limit: a bound must be above 0 Hz",
        ),
        (
            {"topic": {"name": "/scan", "rate": "> 1000000 Hz"}},
            ".topic.rate",
            "'> 1000000 Hz' is too fast to be watched: a bound must be at most 10000 Hz",
        ),
        (
            {"topic": {"name": "/scan", "rate": "> 8 Hz", "window": "100ms"}},
            ".topic.window",
            "100 ms is too short to tell whether a rate is > 8 Hz: a window counts whole messages; "
            "give at least 250 ms",
        ),
        (
            {"topic": {"name": "/scan", "rate": "9 to 11 Hz", "window": "500ms"}},
            ".topic.window",
            "500 ms is too short to tell whether a rate is 9 to 11 Hz: a window counts whole messages; "
            "give at least 1 s",
        ),
        (
            {"topic": {"name": "/scan", "type": "sensor_msgs/LaserScan", "gap": "1s"}},
            ".topic.type",
            "found 'sensor_msgs/LaserScan'; give package/msg/Name",
        ),
        (
            {"topic": {"name": "/scan", "type": "std_srvs/srv/Trigger", "gap": "1s"}},
            ".topic.type",
            "found 'std_srvs/srv/Trigger'; give package/msg/Name",
        ),
        (
            {"parallel": [SCAN, SCAN]},
            ".parallel[1].topic",
            "'scan' is already the name of spec.monitoring.yaml.parallel[0].topic; give one of them another name",
        ),
        (
            {
                "parallel": [
                    CMD_VEL,
                    {"topic": {"name": "/cmd_vel", "type": "std_msgs/msg/String", "gap": "1s"}, "name": "b"},
                ]
            },
            ".parallel[1].topic.type",
            f"found std_msgs/msg/String, but {ROOT}.parallel[0].topic.type says geometry_msgs/msg/Twist "
            "of the same topic /cmd_vel",
        ),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(tree, place, expected):
    assert problems(tree) == [f"{ROOT}{place}: {expected}"]


def test_all_problems_are_reported_at_once():
    found = problems(
        {
            "parallel": [
                {"topic": {"name": "/scan", "gap": "-1s", "rate": "fast"}},
                {"sequence": []},
                {"inverter": {"topik": {}}},
            ]
        }
    )
    assert [line.split(": ")[0] for line in found] == [
        "spec.monitoring.yaml.parallel[0].topic.gap",
        "spec.monitoring.yaml.parallel[0].topic.rate",
        "spec.monitoring.yaml.parallel[1].sequence",
        "spec.monitoring.yaml.parallel[2].inverter.topik",
    ]


def test_problems_begin_with_the_given_path():
    with pytest.raises(TreeError) as caught:
        load({"inverter": 1}, path="configure.tree")  # type: ignore[dict-item]
    assert caught.value.problems == [
        Problem(
            "configure.tree.inverter",
            f"found 1; a node is a mapping with one of {KINDS}",
        )
    ]


def test_a_tree_that_is_too_deep_is_refused_without_recursion():
    tree: dict = SCAN
    for _ in range(5000):
        tree = {"inverter": tree}
    (problem,) = problems(tree)
    assert problem.endswith("the tree is more than 32 levels deep")


def test_a_tree_with_too_many_nodes_is_refused_with_one_problem():
    leaves = [{**SCAN, "name": f"leaf{i}"} for i in range(600)]
    assert_golden("tree_problems", problems({"parallel": leaves}), "spec.monitoring.yaml.parallel", "511", "512")


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"while": {"task_active": {"action": "/go"}}}, "spec.monitoring.yaml.do: missing; give the node"),
        (
            {"while": {}, "do": LEAF},
            "spec.monitoring.yaml.while: found a mapping; 'while' must be a mapping with 'task_active'",
        ),
        (
            {"while": {"task_active": {"action": "go"}}, "do": LEAF},
            "spec.monitoring.yaml.while.task_active.action: found 'go'; did you mean '/go'?",
        ),
        (
            {"while": {"task_active": {"acton": "/go"}}, "do": LEAF},
            "spec.monitoring.yaml.while.task_active.acton: unknown key 'acton', did you mean 'action'?",
        ),
        (
            {"while": {"task_active": {"action": "/go", "type": "a/msg/B"}}, "do": LEAF},
            "spec.monitoring.yaml.while.task_active.type: found 'a/msg/B'; give package/action/Name",
        ),
        (
            {"while": {"task_active": {"action": "/go"}}, "do": LEAF, "settle": 2},
            "spec.monitoring.yaml.settle: found 2, which has no unit",
        ),
        ({"parallel": [LEAF], "do": LEAF}, "spec.monitoring.yaml.do: unknown key; do belongs beside while"),
        (
            {"while": {"task_active": {"action": "/go"}}, "do": {"topic": {"name": "/go/_action/status", "gap": "1s"}}},
            "/go/_action/status is the status of a task's action, which is watched already",
        ),
    ],
)
def test_a_mistake_in_a_while_is_reported(tree, message):
    with pytest.raises(TreeError) as error:
        load(tree)
    assert message in str(error.value)
