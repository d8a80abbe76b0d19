"""Builds the project's container images and brings them to clusters, with or without a registry."""
