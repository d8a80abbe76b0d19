"""Building the project's container images and bringing them to clusters, where a registry can be reached and where none can."""
