"""The monitor of one workload: watches it, and switches, restores and verifies by itself when it fails."""
