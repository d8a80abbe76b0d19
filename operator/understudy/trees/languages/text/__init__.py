"""Shared parts of the languages that are texts: source maps, values with fields, and loading through the short form.

The parts of a single language are in its own folder.
"""
