"""Reads trees in OpenSCENARIO 2 (ASAM OpenSCENARIO DSL 2.1) and converts them into the short form, which alone defines
their meaning.

The parser is that of the package scenario-execution, the tree engine of the paper. None of its behaviours is ever
executed.
"""
