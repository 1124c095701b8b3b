"""``python -m ofsat_ros.cli`` is ``ofsat``."""

from ofsat_ros.cli import main

if __name__ == "__main__":
    main(prog_name="ofsat")
