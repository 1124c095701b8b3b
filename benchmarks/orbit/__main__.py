# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.orbit``."""

import sys

from benchmarks.orbit import main

if __name__ == "__main__":
    sys.exit(main())
