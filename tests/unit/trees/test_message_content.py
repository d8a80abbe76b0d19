"""Leaves that look into messages: what they say, when, and that their deadlines are exact."""

from tests.support.golden import assert_golden
from tests.unit.trees.content_messages import age, during, levels, value
from tests.unit.trees.messages import Battery, ReceivedMessage
from tests.unit.trees.world import START, World
from understudy.trees.core.health_tree import Verdict

# -- value ------------------------------------------------------------------------------------------------------------


def test_a_value_fails_with_one_message_and_recovers_with_the_next():
    world = World(value()).battery(1.0, 0.5)
    assert world.at(1.1).state == "Healthy"
    assert world.deadline(1.1) is None, "silence says nothing of a value"
    verdict = world.battery(2.0, 0.1).at(2.0)
    assert verdict == Verdict("Failed", verdict.reason, "battery.value", START + 1.0)
    assert_golden("health_tree", verdict.reason, "0.15", "/battery")
    assert world.battery(3.0, 0.2).at(3.0) == Verdict("Healthy", "", "", None)


def test_with_for_a_value_fails_exactly_after_it_has_not_held_for_that_time():
    world = World(value(**{"for": "500ms"})).battery(1.0, 0.5)
    assert world.at(1.1).state == "Healthy"
    assert world.battery(2.0, 0.1).at(2.1).state == "Healthy"
    assert world.deadline(2.1) == 2.5
    assert world.battery(2.3, 0.05).at(2.49999).state == "Healthy"
    assert world.deadline(2.49) == 2.5, "the first of them counts"
    verdict = world.at(2.5)
    assert verdict == Verdict("Failed", verdict.reason, "battery.value", START + 1.0)
    assert_golden("health_tree", verdict.reason, "0.15", "/battery", "500 ms")


def test_a_value_that_holds_in_between_restarts_its_time():
    world = World(value(**{"for": "500ms"})).battery(1.0, 0.5)
    world.at(1.0)
    world.battery(1.3, 0.1).at(1.3)
    world.battery(1.7, 0.5).at(1.7)
    world.battery(1.75, 0.1).at(1.75)
    assert world.at(2.2).state == "Healthy"
    assert world.deadline(2.2) == 2.25


def test_with_recovers_a_failed_value_holds_only_when_that_condition_holds():
    world = World(value(recovers="percentage > 0.3", **{"for": "1s"})).battery(1.0, 0.2)
    assert world.at(1.1).state == "Healthy"
    assert world.battery(2.0, 0.1).at(2.0).state == "Healthy"
    assert world.battery(2.9, 0.2).at(3.5).state == "Healthy", "it had not failed yet"
    assert world.battery(4.0, 0.1).at(5.0).state == "Failed"
    assert world.battery(5.5, 0.25).at(6.0).state == "Failed"
    assert world.battery(6.5, 0.31).at(6.5).state == "Healthy"
    assert world.battery(7.0, 0.2).at(9.0).state == "Healthy"


def test_a_value_that_has_never_held_is_starting_until_the_grace_ends():
    world = World(value(recovers="percentage > 0.9"), grace=10)
    assert world.at(1.0).reason == "waiting for the first /battery, for up to 10 s"
    assert world.deadline(1.0) == 10
    world.battery(2.0, 0.1)
    verdict = world.at(9.999)
    assert verdict == Verdict("Starting", verdict.reason, "battery.value", None)
    assert_golden("health_tree", verdict.reason, "0.15", "/battery")
    assert world.deadline(9.0) == 10
    verdict = world.at(10.0)
    assert verdict == Verdict("Failed", verdict.reason, "battery.value", None)
    assert_golden("health_tree", verdict.reason, "0.15", "/battery", "10 s")
    assert world.battery(11.0, 0.5).at(11.0).state == "Healthy", "recovers is for what has held before"
    assert World(value(), grace=10).at(10).reason == "no /battery within 10 s of the start"


def test_an_undecided_value_does_not_hold():
    world = World(value("cells[0] > 1")).hear("/battery", 1.0, Battery(cells=[2.0]))
    assert world.at(1.0).state == "Healthy"
    world.hear("/battery", 2.0, Battery(cells=[]))
    assert_golden("health_tree", world.at(2.0).reason, "/battery")
    world.hear("/battery", 3.0, Battery(cells=[2.0])).at(3.0)
    world.hear("/battery", 4.0, "it is no Battery")
    assert_golden("health_tree", world.at(4.0).reason, "/battery")


def test_only_the_newest_message_of_an_evaluation_is_read_and_only_once():
    world = World({"parallel": [value(), {**value("percentage < 0.9"), "name": "full"}]}).battery(1.0, 0.5)
    reads = []

    class Counted(ReceivedMessage):
        def message(self) -> object:
            reads.append(self.received - START)
            return Battery(percentage=0.5)

    for time in (2.0, 3.0, 4.0):
        world.records["/battery"].contents.append(Counted(START + time))
    for now in (4.1, 4.2, 4.3):
        assert world.at(now).state == "Healthy"
        world.deadline(now)
    assert reads == [4.0, 4.0], "once by each of the two leaves"


def test_the_next_instance_is_judged_by_its_own_messages():
    world = World(value(**{"for": "500ms"}), grace=10).battery(1.0, 0.5)
    assert world.at(1.0).state == "Healthy"
    assert world.battery(2.0, 0.1).at(3.0).state == "Failed"
    world.since = START + 3.5
    assert world.at(3.6).reason == "waiting for the first /battery, for up to 10 s"
    assert world.battery(4.0, 0.5).at(4.0).state == "Healthy"


def test_a_clock_step_moves_remembered_times():
    world = World(value(**{"for": "500ms"})).battery(1.0, 0.5)
    world.at(1.0)
    world.battery(2.0, 0.1).at(2.1)
    world.records["/battery"].shift(3600.0)
    assert world.at(3602.4).state == "Healthy"
    assert world.deadline(3602.4) == 3602.5
    assert world.at(3602.5).onset == START + 3601.0


def test_a_new_tree_for_a_running_instance_has_the_startup_grace():
    world = World({"parallel": [value(), {"topic": {"name": "/scan", "gap": "1s"}}]}, grace=10)
    assert world.at(100.0).state == "Failed"
    world.tree.begin(START + 100.0)
    assert world.at(100.0).state == "Starting"
    assert world.deadline(100.0) == 110
    assert world.battery(101.0, 0.5).hear("/scan", 109.5).at(110.0).state == "Healthy"


def test_a_topic_that_cannot_be_watched_is_left_out():
    world = World({"parallel": [value(), age(), levels()]}, grace=0).hear("/scan", 1.0, late=0.1)
    world.tree.leave_out({"/battery", "/diagnostics"})
    assert world.at(1.0).state == "Healthy"


def test_an_inverter_fails_while_its_value_holds():
    world = World({"inverter": value("charging")}).hear("/battery", 1.0, Battery(charging=True))
    assert world.at(1.0).reason == "charging of /battery holds, but the tree requires the opposite"


# -- for a task -------------------------------------------------------------------------------------------------------


def test_a_value_is_not_judged_without_an_active_task():
    world = World(during(value(**{"for": "500ms"})), grace=5).battery(100.0, 0.1)
    assert world.at(110.0).state == "Healthy"
    assert world.deadline(110.0) is None
    world.task = 120.0
    assert world.at(120.1).state == "Healthy"
    assert world.deadline(120.1) == 122, "its clocks begin with the task, which may settle"
    assert_golden("health_tree", world.at(122.0).reason, "0.15", "/battery", "500 ms", "/go")
    assert world.at(122.0).onset == START + 120.0
    world.task = None
    assert world.at(123.0).state == "Healthy"


def test_after_the_settling_time_a_value_of_a_task_fails_as_any_other():
    world = World(during(value(**{"for": "500ms"}), settle="1s"), grace=5).battery(100.0, 0.5)
    world.task = 100.0
    assert world.at(100.0).state == "Healthy"
    assert world.battery(110.0, 0.1).at(110.1).state == "Healthy"
    assert world.deadline(110.1) == 110.5


def test_an_instance_that_takes_over_an_active_task_has_the_grace_of_a_start():
    world = World(during(value(), settle="1s"), grace=10, since=200).battery(199.9, 0.5)
    world.task = 100.0
    assert world.at(205).state == "Starting"
    assert world.deadline(205) == 210
    assert world.at(210).reason == "no /battery while a goal of /go is active"
    assert world.battery(206, 0.1).at(206).state == "Starting"
    assert world.battery(207, 0.5).at(207).state == "Healthy"
    assert world.battery(208, 0.1).at(208).state == "Failed"
