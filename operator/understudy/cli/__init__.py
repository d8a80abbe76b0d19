"""The command line, with one folder for each family of verbs. `understudy.main` finds the module of a verb."""
