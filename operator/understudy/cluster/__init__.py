"""What touches the Kubernetes API."""
