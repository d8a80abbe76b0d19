"""How a body moves by its odometry: poses, their covariance, and what odometry has said. Nothing but Python."""
