"""Trees in OpenSCENARIO 2 (ASAM OpenSCENARIO DSL 2.1), turned into the short form: what that means is said there alone.

The language is read by the parser of the package scenario-execution, the tree engine of the paper; none of its behaviours is ever run.
"""
