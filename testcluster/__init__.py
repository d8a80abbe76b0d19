"""A real Kubernetes cluster to try and test with: one interface and several providers (see README.md in this folder).

Uses the standard library only, and nothing newer than Python 3.11, because it runs with Debian's own Python before any
environment exists.
"""
