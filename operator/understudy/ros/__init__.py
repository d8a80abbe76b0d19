"""What touches ROS 2: watched topics, who sent a sample, profiles of gated readers. rclpy only where it is needed."""
