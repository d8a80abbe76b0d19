"""How a body moves: poses and their covariance, what odometry has said, and whether it does as it is told. Nothing but Python."""
