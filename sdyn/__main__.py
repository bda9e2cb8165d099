"""`python -m sdyn`: the command line."""

import sys

from sdyn.cli import main

sys.exit(main())
