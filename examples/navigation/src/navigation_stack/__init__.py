"""A navigation stack of managed nodes with the interface of Nav2: map, localization, planner, controller, navigator."""

import os

# One robot's arrays are small: threads of the linear algebra library would cost more than they bring, in five processes.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
