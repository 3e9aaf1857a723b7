"""Write a recording in another layout, from a checkout; installed, the same is `tgslam convert`."""

from __future__ import annotations

import sys

from tgslam.cli import main

if __name__ == "__main__":
    sys.exit(main(["convert", *sys.argv[1:]]))
