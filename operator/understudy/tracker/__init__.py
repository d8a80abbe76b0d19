"""The tracker: finds robots with ArUco markers in the images of a camera, and how fast they move.

It publishes poses and judges nothing.
"""
