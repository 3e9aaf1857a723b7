"""Fig. 6 on one frame of a built-in scene: how `bench ablation` and `bench paper` measure and keep it."""

from __future__ import annotations

import argparse
import json
from typing import Any

from tgslam.bench.ablation import results as table
from tgslam.cli import engine
from tgslam.files.atomic import write_text
from tgslam.output.console import error_console
from tgslam.output.pictures import write_colour
from tgslam.output.progress import step_progress

IDENTITY = "identity"


def measure_identity(args: argparse.Namespace, scene: str, frame: int, size: tuple[int, int]) -> dict[str, Any]:
    """What each identity has learned, as plain values; picture, JSON and Markdown go into `args.output`.

    size: width and height, px. Raises ConfigError for an unknown scene.
    """
    from tgslam.bench.ablation import identity_study as identity
    from tgslam.device.runtime import available_threads

    threads = args.threads or available_threads()
    engine.start_device("cpu", threads)
    with step_progress(IDENTITY, len(identity.IDENTITIES), error_console(), args.quiet) as step:
        found = identity.measure(scene, frame, size, step)
    stem = args.output / f"{IDENTITY}-{scene}"
    write_colour(stem.with_suffix(".png"), identity.picture(found))
    result = {
        "threads": threads,
        "scene": scene,
        "frame": found.frame,
        "width": found.size[0],
        "height": found.size[1],
        "planes": found.planes,
        "gaussians": found.gaussians,
        "iterations": list(identity.ITERATIONS),
        "curves": {curve.identity: {"wrong": curve.wrong, "loss": curve.loss} for curve in found.curves},
    }
    write_text(stem.with_suffix(".json"), json.dumps(result, indent=2, allow_nan=False) + "\n")
    write_text(stem.with_suffix(".md"), table.identity_markdown(result))
    return result
