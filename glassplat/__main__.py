"""`python -m glassplat`: the command line."""

import sys

from glassplat.cli import main

sys.exit(main())
