"""`python -m fidsplat`: the command line of the interpreter at hand."""

import sys

from fidsplat.cli import main

sys.exit(main())
