"""The kinds of gates, one module each. Only ``understudy.kube.gates.registry`` imports them."""
