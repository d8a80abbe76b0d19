"""The command line, with one folder for each family of verbs. `understudy.main` lists the verbs.

Families do not import each other. What two of them share lives in `common`, and what concerns manifests in `manifests`.
"""
