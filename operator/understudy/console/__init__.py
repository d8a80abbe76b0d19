"""Commands that ask a cluster, for people: ``understudy tree``, also as ``kubectl understudy tree``."""
