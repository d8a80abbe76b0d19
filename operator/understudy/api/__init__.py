"""The kinds of ``understudy.dev``: models, names and conditions. Imports nothing else of ours."""
