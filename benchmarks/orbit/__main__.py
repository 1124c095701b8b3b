"""``python -m benchmarks.orbit``."""

import sys

from benchmarks.orbit import main

if __name__ == "__main__":
    sys.exit(main())
