"""``python -m softmode`` is the command line."""

import sys

from softmode.cli import main

sys.exit(main())
