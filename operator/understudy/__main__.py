"""``python -m understudy`` is the ``understudy`` command."""

import sys

from understudy.main import main

sys.exit(main())
