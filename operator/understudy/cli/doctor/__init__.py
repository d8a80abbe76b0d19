"""The verb `doctor`: checks whether a cluster does what Understudy needs. Each finding has its remedy."""
