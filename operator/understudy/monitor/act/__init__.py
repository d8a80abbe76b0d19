"""The fourth stage: carries out what was decided, one step at a time, restartable at every step."""
