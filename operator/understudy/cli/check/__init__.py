"""The verb `check`: validates manifests without a cluster, each object alone and what the objects say about each other."""
