"""How many fallbacks a fleet needs and in which order strategies are tried, with the explanations.

Pure arithmetic; it knows no cluster and no robot.
"""
