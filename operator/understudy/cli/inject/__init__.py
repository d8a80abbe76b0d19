"""The verb `inject`: makes the active instance fail, so that a failure can be rehearsed. Every fault ends by itself."""
