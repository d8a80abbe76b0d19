"""The kinds of `understudy.dev` and the vocabulary that all parts share.

It imports nothing else of ours and makes no calls.
"""
