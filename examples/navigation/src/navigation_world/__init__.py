"""The world of the navigation example: generated from a seed, the same for the robot, for its map and for its goals."""

from navigation_world.generating import DEPTH, RESOLUTION, ROBOT_RADIUS, WIDTH, World, generate
from navigation_world.geometry import Box, Pillar, Pose
from navigation_world.grids import FREE, OCCUPIED, UNKNOWN, Grid, Map

__all__ = [
    "DEPTH",
    "FREE",
    "OCCUPIED",
    "RESOLUTION",
    "ROBOT_RADIUS",
    "UNKNOWN",
    "WIDTH",
    "Box",
    "Grid",
    "Map",
    "Pillar",
    "Pose",
    "World",
    "generate",
]
