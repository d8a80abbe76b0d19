"""The arm on its table: physics at 500 Hz, and servos that hold each joint at its target."""

from __future__ import annotations

import mujoco
import numpy as np
from manipulation_arm import HOME, Joints
from manipulation_arm.model import table_and_arm


class Simulation:
    """One arm. Time is simulated; the caller says how far to go on."""

    def __init__(self, start: Joints = HOME) -> None:
        self._model = mujoco.MjModel.from_xml_string(table_and_arm())
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = start
        self._data.ctrl[:] = start
        self._site = self._model.site("gripper").id
        mujoco.mj_forward(self._model, self._data)

    @property
    def timestep(self) -> float:
        """Seconds of one step."""
        return float(self._model.opt.timestep)

    def drive(self, joints: Joints) -> None:
        """Ask the servos for these positions."""
        self._data.ctrl[:] = joints

    def step(self, steps: int = 1) -> None:
        """Go on by so many timesteps."""
        mujoco.mj_step(self._model, self._data, steps)

    @property
    def positions(self) -> Joints:
        """Where the joints really are."""
        return np.array(self._data.qpos)

    @property
    def velocities(self) -> Joints:
        """How fast they really turn."""
        return np.array(self._data.qvel)

    @property
    def gripper(self) -> tuple[float, float, float]:
        """Where the gripper really is."""
        x, y, z = (float(value) for value in self._data.site_xpos[self._site])
        return x, y, z

    @property
    def touching(self) -> bool:
        """Whether the arm touches something."""
        return bool(self._data.ncon)
