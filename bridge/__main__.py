"""``python -m bridge`` is ``macs``, also where no script directory is on the path."""

import sys

from bridge.cli import main

if __name__ == "__main__":
    sys.exit(main())
