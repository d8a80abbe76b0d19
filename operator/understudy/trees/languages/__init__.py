"""The notations of trees: each is read into the short form, whose meaning is defined once.

Leaves know nothing of notations.
"""
