"""The arm and its table as MuJoCo has them: of the size of a WidowX 250 with six joints, by its published dimensions.

Each link is a capsule. Gravity is compensated for, as position-controlled servos do it. What can be touched is determined by
bits: the table, what stands on it and the arm's own foot are of the kind 1, the links that move of the kind 2, and only
different kinds meet.
"""

from __future__ import annotations

JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")

LIMITS = ((-3.14, 3.14), (-1.88, 1.99), (-2.15, 1.6), (-3.14, 3.14), (-1.74, 2.14), (-3.14, 3.14))
"""How far each joint turns, in rad."""

OBSTACLES = (
    ("post", (0.33, 0.0, 0.14), (0.025, 0.025, 0.14)),
    ("box", (0.05, 0.38, 0.05), (0.08, 0.05, 0.05)),
)
"""What stands on the table: name, middle and half of the size, in m."""

_KINDS = 'contype="{0}" conaffinity="{1}"'
_STILL, _MOVING = _KINDS.format(1, 2), _KINDS.format(2, 1)


def _link(along: str, radius: float, mass: float) -> str:
    return f'<geom type="capsule" fromto="0 0 0 {along}" size="{radius}" mass="{mass}" {_MOVING}/>'


def table_and_arm(padding: float = 0.0) -> str:
    """The model, with joints and actuators of the names in JOINTS, and the site ``gripper`` between its fingers.

    ``padding`` is added to the radius of all that moves, in m, for who plans with some distance to everything.
    """
    limits = [f'range="{low} {high}"' for low, high in LIMITS]
    things = "\n".join(
        f'<geom name="{name}" type="box" pos="{x} {y} {z}" size="{a} {b} {c}" {_STILL}/>'
        for name, (x, y, z), (a, b, c) in OBSTACLES
    )
    servos = "\n".join(
        f'<position name="{joint}" joint="{joint}" kp="{kp}" kv="{kp / 12}" forcerange="-{most} {most}"/>'
        for joint, kp, most in zip(JOINTS, (120, 160, 120, 40, 40, 20), (15, 20, 15, 5, 5, 3), strict=True)
    )
    wide, thin = 0.035 + padding, 0.025 + padding
    return f"""<mujoco model="arm">
<compiler angle="radian" autolimits="true"/>
<option timestep="0.002" integrator="implicitfast"/>
<default><joint type="hinge" damping="0.3" armature="0.02"/></default>
<worldbody>
<geom name="table" type="plane" size="1 1 0.1" {_STILL}/>
{things}
<geom name="foot" type="cylinder" size="0.06 0.035" pos="0 0 0.035" {_STILL}/>
<body name="shoulder" pos="0 0 0.072" gravcomp="1">
 <joint name="waist" axis="0 0 1" {limits[0]}/>
 <geom type="cylinder" size="0.045 0.02" pos="0 0 0.02" mass="0.5" contype="0" conaffinity="0"/>
 <body name="upper_arm" pos="0 0 0.03865" gravcomp="1">
  <joint name="shoulder" axis="0 1 0" {limits[1]}/>
  <geom type="capsule" fromto="0 0 0.03 0.02 0 0.25" size="{wide}" mass="0.5" {_MOVING}/>
  <body name="forearm" pos="0.04975 0 0.25" gravcomp="1">
   <joint name="elbow" axis="0 1 0" {limits[2]}/>
   {_link("0.175 0 0", wide, 0.3)}
   <body name="wrist" pos="0.175 0 0" gravcomp="1">
    <joint name="forearm_roll" axis="1 0 0" {limits[3]}/>
    {_link("0.075 0 0", thin, 0.15)}
    <body name="hand" pos="0.075 0 0" gravcomp="1">
     <joint name="wrist_angle" axis="0 1 0" {limits[4]}/>
     {_link("0.065 0 0", thin, 0.15)}
     <body name="gripper" pos="0.065 0 0" gravcomp="1">
      <joint name="wrist_rotate" axis="1 0 0" {limits[5]}/>
      {_link("0.08 0 0", thin, 0.2)}
      <site name="gripper" pos="0.0936 0 0"/>
     </body>
    </body>
   </body>
  </body>
 </body>
</body>
</worldbody>
<contact><exclude body1="world" body2="upper_arm"/></contact>
<actuator>
{servos}
</actuator>
</mujoco>"""
