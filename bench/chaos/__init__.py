"""A campaign of random faults against robots on the real cluster, judged at the robots.

``plan`` and ``judge`` are pure; ``robots`` builds and starts what is tested; ``apply`` carries faults out, ``witness`` records; ``report``
makes figures and tables.
"""
