"""``python -m softmode`` is the command line."""

import sys

from softmode.cli.main import main

sys.exit(main())
