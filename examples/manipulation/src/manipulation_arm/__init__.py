"""What robot and stack of the manipulation example both know: the arm, its table, and the poses that clients want."""

from manipulation_arm.arm import HOME, Arm, Joints
from manipulation_arm.model import JOINTS
from manipulation_arm.poses import Pose, places

__all__ = ["HOME", "JOINTS", "Arm", "Joints", "Pose", "places"]
