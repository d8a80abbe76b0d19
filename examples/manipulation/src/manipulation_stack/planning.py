"""Ways of the joints round what is in the way: straight where nothing is, else by RRT-Connect of OMPL."""

from __future__ import annotations

import itertools

import numpy as np
from manipulation_arm import Arm, Joints
from numpy.typing import NDArray
from ompl import base, geometric, util

RESOLUTION = 0.02
"""rad between two positions that are looked at, of the joint that moves most."""

SECONDS = 3.0
"""For a try."""

TRIES = 3

util.setLogLevel(util.LogLevel.LOG_ERROR)


class NoWay(Exception):
    """There is no way, or none was found in time."""


def dense(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """The positions of a way from corner to corner, RESOLUTION apart."""
    found = [corners[:1]]
    for begin, end in itertools.pairwise(corners):
        steps = max(1, int(np.ceil(np.abs(end - begin).max() / RESOLUTION)))
        found.append(begin + (end - begin) * (np.arange(1, steps + 1) / steps)[:, None])
    return np.concatenate(found)


def plan(arm: Arm, start: Joints, goal: Joints) -> NDArray[np.float64]:
    """Positions from the start to the goal, all of them free. Raises NoWay.

    A start that is not free, as of an arm that was stopped closer to something than plans keep off, is left at once.
    """
    straight = dense(np.stack([start, goal]))
    if all(arm.free(joints) for joints in straight[1:]):
        return straight
    space = base.RealVectorStateSpace(len(start))
    bounds = base.RealVectorBounds(len(start))
    for joint, (low, high) in enumerate(zip(arm.low, arm.high, strict=True)):
        bounds.setLow(joint, float(low))
        bounds.setHigh(joint, float(high))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: arm.free(_joints(state, len(start))))
    space.setLongestValidSegmentFraction(RESOLUTION / space.getMaximumExtent())
    setup.setStartAndGoalStates(_state(space, _freed(arm, start)), _state(space, goal))
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    for _ in range(TRIES):
        setup.solve(SECONDS)
        if not setup.haveExactSolutionPath():
            break
        setup.simplifySolution(SECONDS)
        corners = np.stack([_joints(state, len(start)) for state in setup.getSolutionPath().getStates()])
        # OMPL looks at other positions between the corners than the arm takes.
        if all(arm.free(joints) for joints in dense(corners)):
            return dense(np.concatenate([start[None], corners]))
        setup.clear()
    raise NoWay(f"no way round what is in the way was found in {TRIES} tries of {SECONDS:g} s")


def _freed(arm: Arm, start: Joints) -> Joints:
    random = np.random.default_rng(0)
    for spread in (0.0, 0.02, 0.05, 0.1):
        for _ in range(20):
            near = start + random.uniform(-spread, spread, len(start))
            if arm.free(near):
                return near
    raise NoWay("the arm touches something where it is")


def _joints(state: base.State, count: int) -> Joints:
    return np.array([state[joint] for joint in range(count)])


def _state(space: base.RealVectorStateSpace, joints: Joints) -> base.State:
    state = space.allocState()
    for joint, position in enumerate(joints):
        state[joint] = float(position)
    return state
