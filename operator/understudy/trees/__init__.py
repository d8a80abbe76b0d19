"""Health trees, procedures and checks as behaviour trees.

No ROS and no Kubernetes calls: what is observed is handed in.
"""
