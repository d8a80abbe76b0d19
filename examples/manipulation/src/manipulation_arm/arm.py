"""Where the gripper is at which joint positions, the other way round, and what the arm bumps into on the way."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from manipulation_arm.model import JOINTS, LIMITS, table_and_arm
from manipulation_arm.poses import Pose

Joints = NDArray[np.float64]
"""One position in rad for each of JOINTS."""

HOME: Joints = np.array((0.0, -0.9, 0.9, 0.0, 0.6, 0.0))
"""Folded over its own foot."""

PLACE, ANGLE = 0.001, 0.005
"""m and rad to which a pose is taken."""

_TRIES, _STEPS, _DAMPING, _STRIDE = 24, 120, 0.03, 0.25


class Arm:
    """The arm as one thinks of it: nothing moves here. Not for several threads at once."""

    def __init__(self, padding: float = 0.01) -> None:
        self._model = mujoco.MjModel.from_xml_string(table_and_arm(padding))
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site("gripper").id
        self.low, self.high = np.array(LIMITS).T

    def pose(self, joints: Joints) -> Pose:
        """Where the gripper is."""
        self._place(joints)
        turned = np.empty(4)
        mujoco.mju_mat2Quat(turned, self._data.site_xmat[self._site])
        return Pose(*(float(value) for value in (*self._data.site_xpos[self._site], *turned)))

    def free(self, joints: Joints) -> bool:
        """Whether it is within its limits there, and touches nothing."""
        if (joints < self.low).any() or (joints > self.high).any():
            return False
        self._place(joints)
        mujoco.mj_collision(self._model, self._data)
        return bool(self._data.ncon == 0)

    def solve(self, pose: Pose, *, over: Callable[[], bool] = lambda: False) -> Joints | None:
        """Joint positions that bring the gripper to a pose, free of collisions; None if there are none.

        By damped least squares, from the same beginnings in the same order each time: so every instance that is asked for
        a pose goes to the same joint positions. ``over`` ends the search.
        """
        random = np.random.default_rng(0)
        facing = HOME.copy()
        facing[0] = math.atan2(pose.y, pose.x)
        for number in range(_TRIES):
            if over():
                break
            begun = (facing, HOME)[number] if number < 2 else random.uniform(self.low, self.high)
            found = self._descended(begun, pose)
            if found is not None and self.free(found):
                return found
        return None

    def _descended(self, begun: Joints, pose: Pose) -> Joints | None:
        joints = begun.copy()
        place, wanted = np.array(pose[:3]), np.array(pose[3:])
        turned, back, error = np.empty(4), np.empty(4), np.empty(6)
        jacobian = np.empty((6, len(JOINTS)))
        for _ in range(_STEPS):
            self._place(joints)
            mujoco.mj_comPos(self._model, self._data)
            error[:3] = place - self._data.site_xpos[self._site]
            mujoco.mju_mat2Quat(turned, self._data.site_xmat[self._site])
            mujoco.mju_negQuat(back, turned)
            mujoco.mju_mulQuat(turned, wanted, back)
            mujoco.mju_quat2Vel(error[3:], turned, 1.0)
            if np.linalg.norm(error[:3]) < PLACE and np.linalg.norm(error[3:]) < ANGLE:
                return joints
            mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._site)
            damped = jacobian @ jacobian.T + _DAMPING**2 * np.eye(6)
            step = jacobian.T @ np.linalg.solve(damped, error)
            joints = np.clip(joints + step * min(1.0, _STRIDE / max(1e-9, np.abs(step).max())), self.low, self.high)
        return None

    def _place(self, joints: Joints) -> None:
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(self._model, self._data)
