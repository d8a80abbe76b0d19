"""Validates manifests without a cluster: ``understudy check``."""
