"""A real Kubernetes cluster for trying and testing, with one face and several providers (see README.md in this folder).

Standard library only, and nothing newer than Python 3.11: it runs with Debian's own Python before any environment
exists.
"""
