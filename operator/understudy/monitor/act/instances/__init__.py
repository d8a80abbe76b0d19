"""The pods of a workload: claims, labels, standbys, the state that they get, and garbage.

Who of them drives is decided in `gate`.
"""
