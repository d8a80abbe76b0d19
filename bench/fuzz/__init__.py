"""Generated objects and texts, and what they may not do to an operator, to a monitor and to other workloads.

``values``, ``trees`` and ``objects`` contain the grammars, ``samples`` draws one object from its seed, ``unaided`` gives
objects to the decoders of this process, and ``campaign`` sends them through an API server.
"""
