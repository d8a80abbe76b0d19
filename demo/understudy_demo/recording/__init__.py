"""The recording of a failover: programs in pseudo-terminals, what they showed and when, and an animated picture of that.

All but ``__main__`` needs no cluster.
"""
