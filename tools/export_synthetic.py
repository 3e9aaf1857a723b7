"""Write a built-in scene as a folder in the TUM RGB-D layout, with its exact trajectory as groundtruth.txt."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.loader import load
from tgslam.conversion.converter import convert
from tgslam.datasets.built_in import SyntheticSource
from tgslam.errors import TgslamError
from tgslam.synthetic.scenes import SCENES

CAMERA_FILE = "camera.yaml"


def export(source: SyntheticSource, folder: Path) -> None:
    """Write every frame of `source` into `folder`: rgb/, depth/ (16-bit PNG), rgb.txt, depth.txt, groundtruth.txt.

    camera.yaml beside them is the config that reads the folder back. Raises OutputError if the folder holds anything
    else already, or if a file cannot be written.
    """
    convert(source, folder, "tum", trajectory=source.groundtruth())


def _parser() -> argparse.ArgumentParser:
    defaults = SyntheticConfig()
    parser = argparse.ArgumentParser(
        description=__doc__, epilog="scenes: " + "; ".join(f"{name} ({spec.about})" for name, spec in SCENES.items())
    )
    parser.add_argument("folder", type=Path, help="folder to write; it must be new or empty")
    parser.add_argument("--scene", default=defaults.scene, choices=tuple(SCENES), help="default: %(default)s")
    parser.add_argument("--frames", type=int, default=defaults.frames, help="at 30 Hz; default: %(default)s")
    parser.add_argument("--width", type=int, default=defaults.width, help="px; default: %(default)s")
    parser.add_argument("--height", type=int, default=defaults.height, help="px; default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the sensor noise; default: %(default)s")
    parser.add_argument("--clean", action="store_true", help="exact depth and colour, without sensor noise")
    parser.add_argument(
        "--exposure-change", type=float, default=0.0, help="amplitude of the gain; default: %(default)s"
    )
    parser.add_argument("--motion-blur", type=int, default=1, help="images per exposure; default: %(default)s")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the tool and return its exit status."""
    options = _parser().parse_args(arguments)
    keys = ("scene", "frames", "width", "height", "exposure_change", "motion_blur")
    settings = [f"synthetic.{key}={getattr(options, key)}" for key in keys]
    try:
        config = load(None, [*settings, f"synthetic.noise={str(not options.clean).lower()}"])
        source = SyntheticSource(config.synthetic, options.seed)
        export(source, options.folder)
    except TgslamError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"{options.folder}: {len(source)} frames of {source.name}; {CAMERA_FILE} is the config that reads them")
    return 0


if __name__ == "__main__":
    sys.exit(main())
