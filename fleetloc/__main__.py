"""``python -m fleetloc``, for processes started by other processes."""

import sys

from fleetloc.cli import main

if __name__ == "__main__":
    sys.exit(main())
