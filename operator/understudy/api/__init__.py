"""The kinds of `understudy.dev` and the names and formats that all parts share.

This package imports no other package of Understudy and makes no calls.
"""
