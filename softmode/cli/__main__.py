"""``python -m softmode.cli`` is the command line, for launchers such as torchrun."""

import sys

from softmode.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
