"""Trees as BehaviorTree.CPP 4 writes them, turned into the short form: what that means is said there alone."""
