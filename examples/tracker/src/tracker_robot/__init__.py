"""The robot of the tracker's example with the camera above it, as one ROS 2 process."""
