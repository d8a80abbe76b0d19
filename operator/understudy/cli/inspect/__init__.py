"""Verbs that show how robots are and change nothing: `status`, `explain`, `timeline`, `tree`, `blackbox`."""
