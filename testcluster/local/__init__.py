"""The `local` provider: a real Kubernetes from Go modules and Debian packages, for machines without Docker.

Linux and root only.
"""
