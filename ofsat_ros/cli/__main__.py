# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``python -m ofsat_ros.cli`` is ``ofsat``."""

from ofsat_ros.cli import main

if __name__ == "__main__":
    main(prog_name="ofsat")
