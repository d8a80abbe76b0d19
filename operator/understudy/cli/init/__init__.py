"""``understudy init``: writes the manifests for an application that runs already.

``application`` reads the Deployment or StatefulSet, ``observed_topics`` measures topics in a recording or on a live ROS graph, and
``written_files`` decides and writes. The verb stands above the others, because it uses what they measure and check.
"""
