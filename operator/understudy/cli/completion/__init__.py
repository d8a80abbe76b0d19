"""The verb `completion`. The answers to a shell are in `cli/common/shell_completion.py`, which every parser uses."""
