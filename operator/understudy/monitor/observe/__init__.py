"""The first stage: what is true at this instant, from ROS, from Kubernetes and from the agents. It judges nothing."""
