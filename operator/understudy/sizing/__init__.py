"""How many fallbacks a fleet needs: failures arrive, each takes a fallback, and some time later there is another in its place.

Pure arithmetic, of no robot and no cluster. The paper's own argument (section IV.D, scaling considerations) is in ``papers``.
"""
