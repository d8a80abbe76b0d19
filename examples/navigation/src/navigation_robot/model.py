"""The robot's body as MuJoCo has it: of the size and weight of a TurtleBot 4, whose base is an iRobot Create 3.

Two driven wheels beside the middle, two casters before and behind, and a hull that walls stop. The laser sees what is
in geometry group 1, which the robot is not part of. The hull is a capsule, since MuJoCo knows exactly where one meets
boxes and pillars; its lower end would reach into the floor, so the hull meets only walls and things, and the wheels only
the floor (bits 1 and 2 determine which geometries meet).
"""

from __future__ import annotations

from navigation_world import ROBOT_RADIUS, Pose, World
from navigation_world.files import mjcf

WHEEL_RADIUS = 0.036
TRACK = 0.233
"""From wheel to wheel, in m."""

LASER = (-0.04, 0.0, 0.2)
"""Where the laser is on the robot, in m from the middle between the wheels, and from the floor."""

_HULL_RADIUS = ROBOT_RADIUS - 0.01
_CASTER = 0.012


def _wheel(name: str, side: float) -> str:
    return f"""<body name="{name}" pos="0 {side} 0">
<joint name="{name}" type="hinge" axis="0 1 0" damping="0.003" armature="0.002"/>
<geom type="cylinder" size="{WHEEL_RADIUS} 0.01" euler="1.5707963 0 0" mass="0.1" friction="1.1 .005 .0001"
 contype="2" conaffinity="2" group="3"/>
</body>"""


def _caster(name: str, x: float) -> str:
    # Without a priority of its own, a caster had the floor's friction: MuJoCo takes the larger one of two geoms.
    return (
        f'<geom name="{name}" type="sphere" size="{_CASTER}" pos="{x} 0 {_CASTER - WHEEL_RADIUS + 0.0005}" mass="0.05" '
        'priority="1" condim="1" contype="2" conaffinity="2" group="3"/>'
    )


def robot_and_world(world: World, start: Pose) -> str:
    """A MuJoCo model of the world with the robot in it.

    Actuators are `left` and `right`, in rad/s; the free joint's pose is that of the middle between the wheels.
    """
    height = LASER[2] - WHEEL_RADIUS
    body = f"""<body name="base" pos="{start.x} {start.y} {WHEEL_RADIUS}" axisangle="0 0 1 {start.heading}">
<freejoint name="base"/>
<geom name="hull" type="capsule" size="{_HULL_RADIUS} 0.045" pos="0 0 0.045" mass="0" friction="0.3 .005 .0001"
 priority="1" solref="0.01 1" group="3"/>
<geom name="mass" type="cylinder" size="{_HULL_RADIUS} 0.045" pos="0 0 0.03" mass="3.4" contype="0" conaffinity="0"
 group="3"/>
{_caster("front", 0.14)}
{_caster("back", -0.14)}
<site name="laser" pos="{LASER[0]} {LASER[1]} {height}"/>
{_wheel("left", TRACK / 2)}
{_wheel("right", -TRACK / 2)}
</body>"""
    after = """<actuator>
<velocity name="left" joint="left" kv="1.5" forcerange="-0.8 0.8"/>
<velocity name="right" joint="right" kv="1.5" forcerange="-0.8 0.8"/>
</actuator>"""
    return mjcf(world, body=body, after=after)
