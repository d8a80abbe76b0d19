"""Everything that touches ROS 2. Understudy imports rclpy only here."""
