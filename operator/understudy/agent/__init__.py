"""The sidecar of an instance: starts what is held, and judges the instance from inside its pod."""
