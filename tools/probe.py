"""Say what a recording is, from a checkout; installed, the same is `tgslam probe`."""

from __future__ import annotations

import sys

from tgslam.cli import main

if __name__ == "__main__":
    sys.exit(main(["probe", *sys.argv[1:]]))
