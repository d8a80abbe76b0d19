"""The pods of a workload: labels, standbys, the state that standbys get, and garbage collection.

`gate` decides which pod drives.
"""
