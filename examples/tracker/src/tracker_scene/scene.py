"""The robot in MuJoCo, with physics at 200 Hz, and what a camera above it sees, rendered without a display (EGL)."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Literal, NamedTuple

# MuJoCo looks at it once, when it is imported.
os.environ.setdefault("MUJOCO_GL", "egl")

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 640, 480
"""Pixels of an image, at most."""
FIELD_OF_VIEW = math.radians(60)
"""Of the image's height."""

MARKER = 7
DICTIONARY = cv2.aruco.DICT_4X4_50
MARKER_SIZE = 0.2
"""The black square's edge, in m."""

MARKER_HEIGHT = 0.2
"""m above the floor."""

MOUNTED = (-0.03, 0.0)
"""Where the marker's middle is on the robot, in m ahead of the middle between the wheels and to the left."""

REFERENCES = {20: (-1.6, -1.1, 0.4), 21: (1.5, -1.2, -1.0), 22: (1.6, 1.1, 2.0), 23: (-1.5, 1.2, 0.0)}
"""Markers on the floor: x and y in m, yaw in rad."""

REFERENCE_SIZE = 0.25

WHEEL, TRACK = 0.036, 0.233
NOISE = 3.0
"""Standard deviation of a pixel's brightness, of 255."""

_PLATE = 0.002
_QUIET = 8 / 6
"""How much larger than the black square a marker is printed: one field of white on each side (4 x 4 fields in a black frame)."""

Fault = Literal["none", "stands", "half speed", "runs on"]
"""What happens to commands: the robot follows them; stands; drives at half speed; or continues the last one."""


class Pose(NamedTuple):
    """x and y in m, heading in rad."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True)
class CameraPlace:
    """Where the camera is: m, and rad about the fixed axes; it looks along its own x axis (REP 103)."""

    x: float = 0.0
    y: float = 0.0
    z: float = 3.0
    roll: float = 0.0
    pitch: float = math.pi / 2
    yaw: float = math.pi / 2


class Scene:
    """One robot and one camera. Time is simulated; the caller says how far to go on."""

    def __init__(
        self,
        start: Pose | None = None,
        camera: CameraPlace | None = None,
        seed: int = 0,
        size: tuple[int, int] = (WIDTH, HEIGHT),
    ) -> None:
        """``size`` is the width and the height of its images in pixels."""
        self._camera = camera or CameraPlace()
        self._model = mujoco.MjModel.from_xml_string(
            _mjcf(start or Pose(0.0, 0.0, 0.0), self._camera), assets=_textures()
        )
        self._data = mujoco.MjData(self._model)
        self._random = np.random.default_rng(seed)
        self._renderer: mujoco.Renderer | None = None
        self._size = size
        self._noise = self._random.normal(0.0, NOISE, (size[1], size[0], 3)).round().astype(np.int16)
        self._heeded = (0.0, 0.0)
        self.fault: Fault = "none"
        self.slip = 0.0
        """The part of the wheels' motion that does not reach the floor."""
        mujoco.mj_step(self._model, self._data, 40)  # down onto its wheels
        self._data.time = 0.0

    def drive(self, speed: float, turn: float) -> None:
        """Command a forward speed in m/s and a turn rate in rad/s; ``fault`` and ``slip`` determine its effect."""
        if self.fault == "stands":
            speed = turn = 0.0
        elif self.fault == "half speed":
            speed, turn = speed / 2, turn / 2
        elif self.fault == "runs on":
            speed, turn = self._heeded
        self._heeded = speed, turn
        kept = 1 - self.slip
        self._data.ctrl[0] = kept * (speed - turn * TRACK / 2) / WHEEL
        self._data.ctrl[1] = kept * (speed + turn * TRACK / 2) / WHEEL

    def step(self, seconds: float) -> None:
        """Go on."""
        mujoco.mj_step(self._model, self._data, round(seconds / self._model.opt.timestep))

    def put(self, pose: Pose) -> None:
        """Put the robot elsewhere, standing."""
        self._data.qpos[:2] = pose.x, pose.y
        self._data.qpos[3:7] = math.cos(pose.heading / 2), 0, 0, math.sin(pose.heading / 2)
        self._data.qvel[:] = 0
        mujoco.mj_forward(self._model, self._data)

    @property
    def time(self) -> float:
        """Simulated seconds since the start."""
        return float(self._data.time)

    @property
    def pose(self) -> Pose:
        """Where the robot really is."""
        x, y, _, w, i, j, k = (float(value) for value in self._data.qpos[:7])
        return Pose(x, y, math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k)))

    @property
    def motion(self) -> tuple[float, float]:
        """How fast it drives forward at this moment, in m/s, and turns, in rad/s; its wheels make that uneven."""
        heading = self.pose.heading
        forward = float(self._data.qvel[0]) * math.cos(heading) + float(self._data.qvel[1]) * math.sin(heading)
        return forward, float(self._data.qvel[5])

    def image(self) -> NDArray[np.uint8]:
        """What the camera sees now: RGB, height x width x 3."""
        if self._renderer is None:
            width, height = self._size
            self._renderer = mujoco.Renderer(self._model, height, width)
        self._renderer.update_scene(self._data, camera="above")
        rendered = self._renderer.render()
        # New noise for each image would cost more than the image.
        noise = np.roll(self._noise, int(self._random.integers(self._noise.size)))
        return cv2.add(rendered, noise, dtype=cv2.CV_8U)

    @staticmethod
    def matrix(size: tuple[int, int] = (WIDTH, HEIGHT)) -> list[float]:
        """The calibration of images of a size, as k of a sensor_msgs/CameraInfo; there is no distortion."""
        width, height = size
        focal = height / 2 / math.tan(FIELD_OF_VIEW / 2)
        return [focal, 0.0, (width - 1) / 2, 0.0, focal, (height - 1) / 2, 0.0, 0.0, 1.0]

    def close(self) -> None:
        """Give the renderer back."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _textures() -> dict[str, bytes]:
    """The markers as they are printed."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    field = 32
    found = {}
    for number in (MARKER, *REFERENCES):
        marker = cv2.aruco.generateImageMarker(dictionary, number, 6 * field)
        printed = cv2.copyMakeBorder(marker, field, field, field, field, cv2.BORDER_CONSTANT, value=255)
        encoded = cv2.imencode(".png", cv2.cvtColor(printed, cv2.COLOR_GRAY2BGR))[1]
        found[f"marker{number}.png"] = bytes(encoded)
    return found


def _plate(number: int, size: float, x: float, y: float, top: float, yaw: float = 0.0) -> str:
    """A printed marker that lies flat."""
    half = size * _QUIET / 2
    return (
        f'<geom name="marker{number}" type="box" size="{half} {half} {_PLATE / 2}" pos="{x} {y} {top - _PLATE / 2}" '
        f'axisangle="0 0 1 {yaw}" material="marker{number}" mass="0.02" contype="0" conaffinity="0"/>'
    )


def _wheel(name: str, side: float) -> str:
    return f"""<body name="{name}" pos="0 {side} 0">
<joint name="{name}" type="hinge" axis="0 1 0" damping="0.003" armature="0.002"/>
<geom type="cylinder" size="{WHEEL} 0.01" euler="1.5707963 0 0" mass="0.1" friction="1.1 .005 .0001" rgba=".1 .1 .1 1"/>
</body>"""


def _caster(x: float) -> str:
    # MuJoCo takes the larger friction of two geoms, unless one has priority.
    return (
        f'<geom type="sphere" size="0.012" pos="{x} 0 {0.0125 - WHEEL}" mass="0.05" priority="1" condim="1" '
        'rgba=".1 .1 .1 1"/>'
    )


def _mjcf(start: Pose, camera: CameraPlace) -> str:
    numbers = (MARKER, *REFERENCES)
    materials = "\n".join(
        f'<texture name="marker{n}" type="2d" file="marker{n}.png"/>'
        f'<material name="marker{n}" texture="marker{n}" specular="0" shininess="0"/>'
        for n in numbers
    )
    floor = "\n".join(_plate(n, REFERENCE_SIZE, x, y, _PLATE, yaw) for n, (x, y, yaw) in REFERENCES.items())
    # MuJoCo's cameras look along -z with y up; bodies' cameras along x with z up.
    axes = _rotation(camera) @ np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    sideways, up = " ".join(map(str, axes[:, 0])), " ".join(map(str, axes[:, 1]))
    return f"""<mujoco>
<compiler angle="radian"/>
<option timestep="0.005" integrator="implicitfast" cone="elliptic"/>
<visual>
<global offwidth="{WIDTH}" offheight="{HEIGHT}"/>
<quality shadowsize="0" offsamples="0"/>
<headlight ambient=".5 .5 .5" diffuse=".4 .4 .4" specular="0 0 0"/>
</visual>
<asset>{materials}</asset>
<worldbody>
<camera name="above" pos="{camera.x} {camera.y} {camera.z}" xyaxes="{sideways} {up}" fovy="{math.degrees(FIELD_OF_VIEW)}"/>
<geom name="floor" type="plane" size="20 20 .1" rgba=".62 .6 .56 1" friction="1 .005 .0001"/>
{floor}
<body name="base" pos="{start.x} {start.y} {WHEEL}" axisangle="0 0 1 {start.heading}">
<freejoint/>
<geom type="cylinder" size="0.17 0.045" pos="0 0 0.06" mass="3.4" rgba=".2 .3 .5 1" contype="0" conaffinity="0"/>
<geom type="cylinder" size="0.02 0.04" pos="{MOUNTED[0]} {MOUNTED[1]} 0.13" mass="0.01" contype="0" conaffinity="0"/>
{_plate(MARKER, MARKER_SIZE, *MOUNTED, MARKER_HEIGHT - WHEEL)}
{_caster(0.14)}
{_caster(-0.14)}
{_wheel("left", TRACK / 2)}
{_wheel("right", -TRACK / 2)}
</body>
</worldbody>
<actuator>
<velocity name="left" joint="left" kv="1.5" forcerange="-0.8 0.8"/>
<velocity name="right" joint="right" kv="1.5" forcerange="-0.8 0.8"/>
</actuator>
</mujoco>"""


def _rotation(camera: CameraPlace) -> NDArray[np.float64]:
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (camera.roll, camera.pitch, camera.yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x
