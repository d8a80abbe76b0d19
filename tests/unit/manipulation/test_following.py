"""Instances that may or may not be in control of one arm: whoever gets through, the arm doesn't jump."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("mujoco")

from manipulation_arm import HOME, Joints
from manipulation_robot.controller import Controller
from manipulation_stack.following import Follower
from manipulation_stack.motion import SPEED, Command, Motion

PERIOD = 0.02
UNDISTURBED = SPEED * PERIOD


def motion(*corners: float) -> Motion:
    """Through these positions of the first joint, and back with the second one."""
    way = np.tile(HOME, (1 + len(corners), 1))
    way[1:, 0] += corners
    points = [HOME[None]]
    for begin, end in pairwise(way):
        points.append(np.linspace(begin, end, 101)[1:])
    return Motion(np.concatenate(points))


class Scene:
    """An arm and those that command it, each of which hears the arm's reference some ticks late."""

    def __init__(self, *followers: Follower, late: int = 3, apart: float = 0.1) -> None:
        self.followers = followers
        self.controller = Controller(HOME)
        self.steps: list[float] = []
        self._delayed = deque([self._reference(0.0)] * late, maxlen=late)
        self._now = 0.0
        self._apart = apart
        # Mostly no two processes tick at exactly the same intervals.
        self._ticks = np.random.default_rng(3)

    def _reference(self, now: float) -> Command:
        return Command(self.controller.positions.copy(), self.controller.velocities(now).copy())

    def run(self, seconds: float, *, through: int | None, silent: tuple[int, ...] = ()) -> None:
        """Let time pass, with the commands of one of them getting through to the arm."""
        for _ in range(round(seconds / PERIOD)):
            self._now += PERIOD
            target = self._delayed[0]
            for number, follower in enumerate(self.followers):
                if number in silent:
                    continue
                command = follower.step(
                    target, self._now, PERIOD * self._ticks.uniform(1 - self._apart, 1 + self._apart)
                )
                if number == through and command is None:
                    self.steps.append(self.controller.stay(now=self._now))
                elif number == through:
                    self.steps.append(self.controller.command(command.positions, command.velocities, now=self._now))
            self._delayed.append(self._reference(self._now))

    @property
    def delayed_command(self) -> Command:
        """What the arm has said last."""
        return self._delayed[-1]

    @property
    def moved(self) -> float:
        """Of the first joint."""
        return float(self.controller.positions[0] - HOME[0])


def assert_no_jump(scene: Scene) -> None:
    assert max(scene.steps) <= 1.2 * UNDISTURBED


def test_an_active_instance_completes_its_motion() -> None:
    scene = Scene(Follower(motion(1.0)))
    scene.run(4.0, through=0)
    assert scene.moved == pytest.approx(1.0)
    assert scene.followers[0].arrived
    assert_no_jump(scene)


def test_a_standby_stays_one_step_from_the_arm_and_takes_over_without_a_jump() -> None:
    scene = Scene(Follower(motion(1.0)), Follower(motion(1.0)))
    scene.run(0.9, through=0)
    before = scene.moved
    assert 0.2 < before < 0.8
    scene.run(0.3, through=None, silent=(0,))
    assert scene.moved == before, "it holds"
    scene.run(4.0, through=1, silent=(0,))
    assert scene.moved == pytest.approx(1.0)
    assert_no_jump(scene)


@pytest.mark.parametrize("gap", [0.0, 0.02, 0.06, 0.1, 0.2, 1.0, 3.0])
def test_a_gap_without_commands_of_any_length_causes_no_jump(gap: float) -> None:
    scene = Scene(Follower(motion(1.0)), Follower(motion(1.0)))
    scene.run(0.9, through=0)
    scene.run(gap, through=None, silent=(0,))
    scene.run(4.0, through=1, silent=(0,))
    assert scene.moved == pytest.approx(1.0)
    assert_no_jump(scene)


@pytest.mark.parametrize("gap", [0.04, 0.1, 0.16, 0.5])
def test_two_synchronous_instances_do_not_confuse_their_commands(gap: float) -> None:
    scene = Scene(Follower(motion(1.0)), Follower(motion(1.0)), late=1, apart=0.0)
    scene.run(0.9, through=0)
    scene.run(gap, through=None, silent=(0,))
    scene.run(3.5, through=1, silent=(0,))
    assert scene.moved == pytest.approx(1.0)
    assert_no_jump(scene)


def test_an_instance_that_is_cut_off_for_a_long_time_resumes_without_a_jump() -> None:
    scene = Scene(Follower(motion(1.0)))
    scene.run(0.9, through=0)
    scene.run(3.0, through=None)
    scene.run(4.0, through=0)
    assert scene.moved == pytest.approx(1.0)
    assert_no_jump(scene)


def test_a_restarted_instance_continues_from_the_position_of_the_arm() -> None:
    scene = Scene(Follower(motion(1.0)))
    scene.run(0.9, through=0)
    scene.run(0.3, through=None)
    left = scene.moved
    way = np.linspace(scene.controller.positions, HOME + np.array((1.0, 0, 0, 0, 0, 0)), 60)
    scene.followers = (Follower(Motion(way)),)
    scene.run(0.5, through=0)
    assert left < scene.moved < 1.0
    scene.run(4.0, through=0)
    assert scene.moved == pytest.approx(1.0)
    assert_no_jump(scene)


def test_a_standby_with_another_path_waits_at_the_arm_and_requests_a_new_path() -> None:
    scene = Scene(Follower(motion(1.0)), Follower(motion(-1.0)))
    scene.run(0.9, through=0)
    first, other = scene.followers
    assert other.strayed
    assert not first.strayed
    scene.run(0.2, through=None, silent=(0,))
    held = scene.moved
    scene.run(0.5, through=1, silent=(0,))
    assert scene.moved == held
    other.replace(Motion(np.linspace(scene.controller.positions, HOME, 60)))
    scene.run(4.0, through=1, silent=(0,))
    assert scene.moved == pytest.approx(0.0, abs=1e-6)
    assert not other.strayed
    assert_no_jump(scene)


@pytest.mark.parametrize("gap", [0.02, 0.06, 0.1, 0.3, 1.5])
@pytest.mark.parametrize("late", [1, 3])
@pytest.mark.parametrize("ticks", range(6))
def test_a_standby_with_a_new_path_stays_one_step_from_the_arm_until_it_takes_over(
    ticks: int, late: int, gap: float
) -> None:
    scene = Scene(Follower(motion(1.0)), Follower(motion(-1.0)), late=late)
    scene.run(0.9, through=0)
    other = scene.followers[1]
    assert other.strayed, "it has repeated where the arm is, which nobody has followed"
    scene.run(ticks * PERIOD, through=None, silent=(0,))
    # It goes on as the arm went, and then somewhere else: so it begins at the speed of an arm that seems to move still.
    on, end = scene.controller.positions + np.array((0.2, 0, 0, 0, 0, 0)), HOME + np.array((0.7, 0.2, 0, 0, 0, 0))
    way = [np.linspace(scene.controller.positions, on, 60), np.linspace(on, end, 60)[1:]]
    other.replace(Motion(np.concatenate(way)))
    scene.run(gap, through=None, silent=(0,))
    scene.run(4.0, through=1, silent=(0,))
    assert scene.controller.positions == pytest.approx(end, abs=1e-5)
    assert_no_jump(scene)


@pytest.mark.parametrize("seed", range(40))
def test_a_takeover_at_any_time_with_any_path_causes_no_jump(seed: int) -> None:
    chance = np.random.default_rng(seed)
    late, apart = int(chance.integers(1, 4)), float(chance.choice([0.0, 0.1]))
    target = HOME + np.array((1.0, 0.3, -0.2, 0, 0, 0))
    followers = [Follower(some_way(HOME, target, chance)) for _ in range(2)]
    scene, planning = Scene(*followers, late=late, apart=apart), [0.0, 0.0]

    def run(seconds: float, *, through: int | None, silent: tuple[int, ...] = ()) -> None:
        """As the planner does it, one that has strayed gets a way from where the arm was a moment ago."""
        for tick in range(round(seconds / PERIOD)):
            scene.run(PERIOD, through=through, silent=silent)
            for number, follower in enumerate(followers):
                if follower.strayed and number not in silent and tick * PERIOD >= planning[number]:
                    follower.replace(some_way(scene.delayed_command.positions, target, chance))
                    planning[number] = tick * PERIOD + chance.uniform(0.05, 0.5)

    run(chance.uniform(0.3, 2.0), through=0)
    run(chance.uniform(0.0, 0.8), through=None, silent=(0,))
    planning = [0.0, 0.0]
    run(8.0, through=1, silent=(0,))
    assert scene.controller.positions == pytest.approx(target, abs=1e-5)
    assert_no_jump(scene)


def some_way(start: Joints, target: Joints, chance: np.random.Generator) -> Motion:
    """One of the many ways to the target, which planners find by chance."""
    aside = chance.uniform(-0.3, 0.3, len(start)) * (chance.random() < 0.7)
    corner = start + (target - start) * chance.uniform(0.2, 0.8) + aside
    return Motion(np.concatenate([np.linspace(start, corner, 80), np.linspace(corner, target, 80)[1:]]))


def test_an_arm_that_lags_behind_does_not_move_back() -> None:
    scene = Scene(Follower(motion(1.0)))
    scene.run(0.9, through=0)
    scene.run(0.3, through=None)
    before = scene.moved
    moved = []
    for _ in range(50):
        scene.run(PERIOD, through=0)
        moved.append(scene.moved)
    assert min(moved) >= before


@pytest.mark.parametrize("stalled", [0.2, 1.0, 5.0])
def test_a_silent_arm_does_not_count_as_following_another_instance(stalled: float) -> None:
    follower = Follower(motion(1.0))
    scene = Scene(follower)
    scene.run(0.9, through=0)
    silent = Command(scene.controller.positions.copy(), scene.controller.velocities(0.0).copy())
    waiting = []
    now = 0.9
    for _ in range(round(stalled / PERIOD)):
        now += PERIOD
        waiting.append(follower.step(silent, now, PERIOD))
    # It takes up all that it was sent meanwhile.
    steps = [scene.controller.command(c.positions, c.velocities, now=now) for c in waiting]
    assert max(steps) <= 1.2 * UNDISTURBED
    assert len({c.positions.tobytes() for c in waiting[10:]}) <= 1, "it rests"
