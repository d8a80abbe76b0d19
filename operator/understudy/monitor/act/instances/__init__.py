"""The pods of a workload: labels, standbys, the state that they get, and garbage.

Who of them drives is decided in `gate`.
"""
