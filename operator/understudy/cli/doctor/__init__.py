"""The verb `doctor`: whether a cluster does what Understudy needs, each finding with its remedy."""
