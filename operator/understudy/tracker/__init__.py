"""The tracker: where robots with ArUco markers are, and how fast they move, as a camera sees them.

It publishes poses and judges nothing.
"""
