"""Shell completion: the verb `completion`, and the answers that it makes a shell ask for."""
