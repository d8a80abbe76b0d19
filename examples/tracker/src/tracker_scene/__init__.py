"""A robot with an ArUco marker on it, and a camera above the floor."""

from tracker_scene.scene import MOUNTED, Fault, Pose, Scene

__all__ = ["MOUNTED", "Fault", "Pose", "Scene"]
