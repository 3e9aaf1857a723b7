"""A whole `tgslam run` in a process of its own: seconds by stage, and how soon the first frame is tracked.

It is run twice, with an empty cache of compiled kernels and with the cache that the first run has filled. The cache is
a temporary folder, so that the user's own stays as it is.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import tgslam
from tgslam.errors import EvaluationError
from tgslam.output.log import read_log
from tgslam.output.run_folder import RunFolder
from tgslam.types import FrameStatus

CACHES = ("cold", "warm")
_POLL_S = 0.01  # how exactly the time of the first tracked frame is known
_METRICS = ("frames", "tracked_fraction", "keyframes", "gaussians", "fps", "wall_s", "peak_rss_mb", "stage_s")


def measure(arguments: Sequence[str], step: Callable[[str], None]) -> list[dict[str, Any]]:
    """The run with a cold and a warm cache. arguments: of `tgslam run`, without an output folder.

    step: told of each run as it begins. Raises EvaluationError when a run fails; it has said why on stderr.
    """
    with tempfile.TemporaryDirectory(prefix="tgslam-bench-") as name:
        folder = Path(name)
        (folder / "kernels").mkdir()
        reports = []
        for cache in CACHES:
            step(f"{cache} kernel cache")
            reports.append({"cache": cache} | _one_run(arguments, folder / "kernels", folder / cache))
    return reports


def child_environment(**variables: str) -> dict[str, str]:
    """The environment for another process of this very tgslam, wherever it was imported from."""
    packages = str(Path(tgslam.__file__).resolve().parents[1])
    path = os.pathsep.join(filter(None, (packages, os.environ.get("PYTHONPATH", ""))))
    return {**os.environ, "PYTHONPATH": path, **variables}


def _one_run(arguments: Sequence[str], kernels: Path, folder: Path) -> dict[str, Any]:
    """Times of one run. Every clock starts with the process, before Python itself does."""
    clock, output = folder.with_suffix(".json"), folder
    command = [sys.executable, "-m", "tgslam.bench.compile_clock", str(clock), "run", *arguments]
    environment = child_environment(TI_OFFLINE_CACHE_FILE_PATH=str(kernels), ENABLE_TAICHI_HEADER_PRINT="0")
    start = time.perf_counter()
    with subprocess.Popen(
        [*command, "--output", str(output), "--quiet"], env=environment, stdout=subprocess.DEVNULL
    ) as process:
        first_tracked_s = None
        while process.poll() is None:
            if first_tracked_s is None and _has_tracked(output):
                first_tracked_s = time.perf_counter() - start
            time.sleep(_POLL_S)
        process_s = time.perf_counter() - start
    if process.returncode:
        raise EvaluationError(f"the run with the kernel cache in {kernels} ended with exit code {process.returncode}")
    metrics = RunFolder.open(output).read_metrics()
    compiling = json.loads(clock.read_text(encoding="utf-8"))
    return {
        "first_tracked_s": first_tracked_s,
        "process_s": process_s,
        "kernels": compiling.pop("kernels"),
        "compile_s": compiling,
        **{name: metrics[name] for name in _METRICS},
    }


def _has_tracked(output: Path) -> bool:
    """Whether the log of the run says so yet."""
    log = RunFolder(output).log
    return log.is_file() and any(report.status is FrameStatus.TRACKED for report in read_log(log))
