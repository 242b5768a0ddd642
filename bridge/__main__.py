"""``python -m bridge`` is ``macs``, also where no script directory is on the path."""

import sys

from bridge.cli import program

if __name__ == "__main__":
    sys.exit(program())
