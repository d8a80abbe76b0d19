"""The first stage: observes ROS, Kubernetes and the agents at one instant. It judges nothing."""
