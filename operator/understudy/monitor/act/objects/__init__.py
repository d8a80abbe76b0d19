"""The gate and the pods of one workload: the requests with which the act stage changes the cluster.

The other folders of this stage decide when to make them.
"""
