"""Building the project's container images and bringing them to clusters, with a registry or without."""
