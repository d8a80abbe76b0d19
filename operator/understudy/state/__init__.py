"""The state of the last healthy instance: which messages count, where they are stored, and how a pose is brought up to date.

Pure except for the files of the store.
"""
