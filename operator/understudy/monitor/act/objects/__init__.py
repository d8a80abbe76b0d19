"""The gate and the pods of one workload: what the act stage changes in the cluster, one request at a time.

When and why something is changed is decided in the other folders of this stage.
"""
