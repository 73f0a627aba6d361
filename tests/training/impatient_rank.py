"""`python -m glassplat` that gives a silent rank up after seconds, in place of ten minutes."""

from __future__ import annotations

import sys
from datetime import timedelta

from glassplat.cli.main import main
from glassplat.training import ranks

if __name__ == "__main__":
    ranks.LONGEST_WAIT = timedelta(seconds=15)
    sys.exit(main())
