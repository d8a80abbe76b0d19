"""The notations of trees. Each is converted into the short form, whose meaning is defined once.

Leaves do not depend on notations.
"""
