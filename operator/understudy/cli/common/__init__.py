"""What the verbs share: kubectl, terminals, tables, options. A module here is used by two families or more."""
