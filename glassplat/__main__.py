"""`python -m glassplat`: the command line."""

import sys

from glassplat.cli.main import main

sys.exit(main())
