"""``understudy try``: a robot that survives a frozen application, with processes of this machine and without a cluster.

The gate, the DDS partitions and the health tree are those of a cluster. The robot, its application and the API server are simulated.
"""
