# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.soak``."""

from benchmarks.soak import main

if __name__ == "__main__":
    main()
