"""`python -m tgslam`: the same as the `tgslam` command."""

import sys

from tgslam.cli import main

if __name__ == "__main__":
    sys.exit(main())
