"""Verbs that change how a robot is protected or driven: `pause`, `resume`, `failover`, `failback`, `fence`, `robot-profile`."""
