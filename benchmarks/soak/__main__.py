"""``python -m benchmarks.soak``."""

from benchmarks.soak import main

if __name__ == "__main__":
    main()
