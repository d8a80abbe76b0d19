"""Whether a robot follows its commands: what is allowed never fails, what isn't does, and chance does as seldom as promised."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from understudy.kinematics.command_following import SILENT, Allowance, CommandFollowing, Motion, Reach, Sums

ALLOWED = Allowance()
PERIOD, IMAGE = 0.05, 0.1
CERTAIN = Motion(1e-6, 1e-6, 1e-6)
Command = Callable[[float], float]


def forward(speed: float) -> Motion:
    return Motion(speed, 0.0, 0.0)


class Robot:
    """One that heeds its commands after a delay, at an acceleration, or doesn't from some time on."""

    def __init__(self, delay: float, acceleration: float, slip: float = 0.0, lag: float = 0.0, stops: float = math.inf):
        self.delay, self.acceleration, self.slip, self.lag, self.stops = delay, acceleration, slip, lag, stops
        self.speed = 0.0

    def step(self, now: float, command: Command, seconds: float) -> float:
        wanted = command(now - self.delay) if now >= self.delay else 0.0
        most = self.acceleration * seconds
        change = wanted - self.speed
        if self.lag:
            change *= 1 - math.exp(-seconds / self.lag)
        self.speed += min(most, max(-most, change))
        return self.speed * (1 - self.slip) if now < self.stops else 0.0


def watch(
    robot: Robot,
    command: Command,
    until: float,
    *,
    following: CommandFollowing | None = None,
    late: float = 0.06,
    noise: Callable[[], float] = lambda: 0.0,
    visible: Callable[[float], bool] = lambda now: True,
) -> float | None:
    """When the robot is first found not to follow; None for never. Its velocity is seen as the mean of half a second."""
    following = following or CommandFollowing(ALLOWED)
    recent: list[float] = []
    for tick in range(round(until * 100)):
        now = tick / 100
        if tick % 5 == 0:
            following.command(now, forward(command(now)))
        recent = [*recent[-49:], robot.step(now, command, 0.01)]
        if tick % 10 == 0 and tick >= 50 and visible(now):
            following.see(now + late, forward(sum(recent) / len(recent) + noise()), CERTAIN)
        if following.discrepancy(now + late) is not None:
            return now + late
    return None


def steps(changes: list[tuple[float, float]]) -> Command:
    """A command that is held from one change to the next; each is a time that it lasts and a speed."""

    def command(now: float) -> float:
        at = 0.0
        for lasts, speed in changes:
            at += lasts
            if now < at:
                return math.floor(speed * 100) / 100
        return 0.0

    return lambda now: command(math.floor(now / PERIOD + 1e-9) * PERIOD)


DRIVES = st.lists(st.tuples(st.floats(0.1, 3.0), st.sampled_from([-0.3, 0.0, 0.1, 0.2, 0.3, 0.5])), max_size=8)


@settings(max_examples=60, deadline=None)
@given(
    drive=DRIVES,
    delay=st.floats(0.0, 0.2),
    acceleration=st.floats(0.5, 50.0),
    slip=st.floats(-0.15, 0.15),
    seed=st.integers(0, 1000),
)
def test_a_robot_within_its_limits_never_fails(drive, delay, acceleration, slip, seed):
    random = np.random.default_rng(seed)
    robot = Robot(delay, acceleration, slip)
    assert watch(robot, steps(drive), 12.0, noise=lambda: float(random.normal(0, 0.005))) is None


@settings(max_examples=20, deadline=None)
@given(drive=DRIVES, lag=st.floats(0.02, 0.2), gaps=st.lists(st.floats(0, 12), max_size=4))
def test_a_robot_that_lags_and_is_sometimes_out_of_sight_never_fails(drive, lag, gaps):
    robot = Robot(0.1, 5.0, lag=lag)
    hidden = lambda now: not any(gap <= now < gap + 1.5 for gap in gaps)  # noqa: E731
    assert watch(robot, steps(drive), 12.0, visible=hidden) is None


@pytest.mark.parametrize("speed", [0.3, -0.3, 0.6])
def test_a_standing_robot_is_detected_within_a_second(speed):
    for stops in (4.0, 4.03, 4.07):
        found = watch(Robot(0.1, 1.0, stops=stops), lambda now: speed, 8.0)
        assert found is not None
        assert 0.2 < found - stops < 0.9


def test_a_robot_that_never_starts_to_move_is_detected():
    found = watch(Robot(0.1, 1.0, stops=0.0), lambda now: 0.3 if now > 1 else 0.0, 8.0)
    assert found is not None
    # The longest delay, the window, the slowest acceleration, and the test itself.
    assert found < 1 + 0.3 + 0.5 + 0.3 / 0.5 + 0.7


def test_a_robot_that_moves_without_a_command_is_detected():
    following = CommandFollowing(ALLOWED)
    for tick in range(60):
        following.command(tick * PERIOD, forward(0.0))
        following.see(tick * PERIOD, forward(0.0), CERTAIN)
    assert following.discrepancy(3.0) is None
    for tick in range(60, 80):
        following.command(tick * PERIOD, forward(0.0))
        following.see(tick * PERIOD, forward(0.2), CERTAIN)
    assert_golden("kinematics", str(following.discrepancy(4.0)), "0.20 m/s", "0.00 m/s")


def turning(
    following: CommandFollowing, commanded: Motion, measured: Motion, begin: float = 0.0, seconds: float = 4.0
) -> CommandFollowing:
    for tick in range(round(seconds * 10)):
        following.command(begin + tick * IMAGE, measured)
        following.see(begin + tick * IMAGE + 0.01, commanded, CERTAIN)
    return following


def test_rotation_and_sideways_motion_are_compared_too():
    commanded = Motion(0.2, 0.1, 0.5)
    assert turning(CommandFollowing(ALLOWED), commanded, commanded).discrepancy(4.0) is None
    found = turning(CommandFollowing(ALLOWED), commanded._replace(turn=-0.5), commanded).discrepancy(4.0)
    assert found is not None
    assert found.component == "turning"
    found = turning(CommandFollowing(ALLOWED), commanded._replace(left=-0.2), commanded).discrepancy(4.0)
    assert found is not None
    assert found.component == "sideways"


def test_a_detected_robot_recovers_when_it_follows_again():
    robot = Robot(0.1, 1.0, stops=4.0)
    following = CommandFollowing(ALLOWED)
    assert watch(robot, lambda now: 0.3, 5.0, following=following) is not None
    well = following.well
    turning(following, forward(0.3), forward(0.3), begin=5.0, seconds=2.0)
    assert following.discrepancy(7.0) is None
    assert well is not None
    assert 4.0 < well < 4.5, "it was last well when it stopped"


def test_a_robot_out_of_sight_is_undecided_and_evidence_starts_again():
    following = CommandFollowing(ALLOWED)
    found = watch(Robot(0.1, 1.0, stops=4.0), lambda now: 0.3, 5.2, following=following)
    assert found is not None
    until = following.until
    assert until is not None
    assert following.discrepancy(until - 0.01) is not None
    assert following.discrepancy(until) is None
    later = until + 10
    following.command(later, forward(0.3))
    following.see(later, forward(0.0), CERTAIN)
    assert following.discrepancy(later) is None, "one look is not enough"


def test_without_a_recent_command_any_motion_is_allowed():
    following = CommandFollowing(ALLOWED)
    for tick in range(50):
        following.see(tick * IMAGE, forward(0.5), CERTAIN)
    assert following.discrepancy(5.0) is None
    assert not following.is_known
    following = turning(CommandFollowing(ALLOWED), forward(0.3), forward(0.3))
    for tick in range(40):
        # Nobody commands any more: it may go on, or stop, as its base does.
        following.see(4.0 + SILENT + tick * IMAGE, forward(0.0), CERTAIN)
    assert following.discrepancy(9.0) is None


def test_motion_from_before_the_first_command_may_take_time_to_end():
    following = CommandFollowing(ALLOWED)
    for tick in range(100):
        now = tick * PERIOD
        following.command(now, forward(0.0))
        following.see(now + 0.01, forward(max(0.0, 0.8 - 0.5 * now)), CERTAIN)
        assert following.discrepancy(now + 0.01) is None


def test_a_single_outlier_is_no_failure():
    following = turning(CommandFollowing(ALLOWED), forward(0.3), forward(0.3))
    following.see(4.1, forward(-50.0), CERTAIN)
    assert following.discrepancy(4.1) is None
    turning(following, forward(0.3), forward(0.3), begin=4.2)
    assert following.discrepancy(8.0) is None


def test_an_uncertain_observation_delays_the_detection():
    def seconds(variance: float) -> float:
        following = turning(CommandFollowing(ALLOWED), forward(0.3), forward(0.3))
        for tick in range(1000):
            now = 4.0 + tick * IMAGE
            following.command(now, forward(0.3))
            following.see(now, forward(0.0), Motion(variance, variance, variance))
            if following.discrepancy(now) is not None:
                return now - 4.0
        return math.inf

    assert seconds(1e-6) < seconds(0.01) < seconds(0.03) < math.inf


def test_a_step_of_the_clock_changes_nothing():
    plain, moved = CommandFollowing(ALLOWED), CommandFollowing(ALLOWED)
    times: dict[CommandFollowing, float | None] = {}
    for following, step in ((plain, 0.0), (moved, 3600.0)):
        turning(following, forward(0.3), forward(0.3))
        following.shift(step)
        for tick in range(20):
            now = 4.0 + step + tick * IMAGE
            following.command(now, forward(0.3))
            following.see(now, forward(0.0), CERTAIN)
            if following.discrepancy(now) is not None:
                times[following] = now - step
                break
    assert times[plain] == pytest.approx(times[moved])


def test_noise_exceeds_the_threshold_no_more_often_than_the_bound():
    """By Lorden's bound, once in exp(h) independent observations at most; here also for those that overlap."""
    random = np.random.default_rng(3)
    h, sigma, least, overlap, count = 3.0, 0.02, 0.06, 5, 60_000
    independent = random.normal(0, sigma, count)
    # The mean of five that follow each other, as a window makes it, scaled to the same spread.
    overlapping = np.convolve(independent, np.ones(overlap) / math.sqrt(overlap), "valid")
    for values, part in ((independent, 1.0), (overlapping, 1 / overlap)):
        sums, alarms = Sums(h, least), 0
        for time, value in enumerate(values):
            sums.add(float(time), float(value), 0.0, math.inf, sigma**2, part)
            if sums.failed:
                alarms += 1
                sums = Sums(h, least)
        assert alarms <= len(values) * part / math.exp(h)
        assert alarms > 0, "the bound is not so wide that it says nothing"


@given(
    commands=st.lists(st.tuples(st.floats(0, 0.6), st.floats(-1, 1)), min_size=1, max_size=40),
    after=st.floats(0, 3),
)
def test_discarded_commands_had_no_influence(commands, after):
    """The bounds are those of all commands there ever were."""
    reach, slack, acceleration = Reach(0.5, 0.8), 0.8, 0.5
    pieces: list[tuple[float, float]] = []
    now, last = 0.0, None
    for gap, value in commands:
        now += gap
        if last is not None:
            if gap > SILENT:
                pieces.append((0.0, now))
            pieces.append((last, now))
        reach.command(now, value)
        last = value
        reach.bounds(now)
    time = now + after
    assert last is not None
    faded = [(value, acceleration * max(0.0, time - end - slack)) for value, end in pieces]
    highs = [last, *(value - over for value, over in faded)]
    lows = [last, *(value + over for value, over in faded)]
    if after > SILENT:
        highs.append(0.0)
        lows.append(0.0)
    found = reach.bounds(time)
    assert found is not None
    assert found == pytest.approx((min(lows), max(highs)))
