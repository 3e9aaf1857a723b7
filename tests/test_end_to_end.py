"""The real system on a few small frames of the built-in room, through the command line as users start it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
SMALL = ("--set", "synthetic.width=96", "--set", "synthetic.height=72")
TIMEOUT_S = 300


def start(folder: Path, *arguments: str, one_core: bool = False) -> subprocess.Popen[str]:
    pin = one_core and hasattr(os, "sched_setaffinity")
    return subprocess.Popen(
        [sys.executable, "-m", "tgslam", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=(lambda: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})) if pin else None,
    )


def succeed(process: subprocess.Popen[str]) -> str:
    """The stdout of a command, which must succeed."""
    out, err = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, err
    return out


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the same run twice, a and b, made side by side: most of it is compilation on one thread.

    Where the system can be told so, b has a single core, since results must not depend on the number of threads.
    """
    folder = tmp_path_factory.mktemp("runs")
    command = ("run", *SMALL, "--frames", "0:8", "--output")
    processes = {name: start(folder, *command, name, one_core=name == "b") for name in ("a", "b")}
    for name, process in processes.items():
        assert succeed(process).startswith(f"synthetic-room -> {name}\n")
    return folder


def test_a_run_repeats_bit_for_bit(runs: Path) -> None:
    for name in ("trajectory.txt", "keyframes.txt", "map.ply", "map_extra.npz", "planes.json"):
        assert (runs / "a" / name).read_bytes() == (runs / "b" / name).read_bytes()


def test_a_run_tracks_and_maps(runs: Path) -> None:
    metrics = json.loads((runs / "a" / "metrics.json").read_text())
    assert metrics["frames"] == 8
    assert metrics["tracked_fraction"] == 1
    assert metrics["ate_rmse_all_cm"] < 2
    assert metrics["gaussians"] > 500


def test_eval_repeats_the_metrics_of_the_run(runs: Path) -> None:
    before = json.loads((runs / "b" / "metrics.json").read_text())
    succeed(start(runs, "eval", "b"))
    assert json.loads((runs / "b" / "metrics.json").read_text()) == before


def test_render_draws_the_map(runs: Path) -> None:
    succeed(start(runs, "render", "a", "--orbit", "--count", "2"))
    assert len(list((runs / "a" / "render-orbit" / "colour").iterdir())) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGTERM handlers there")
def test_a_terminated_run_leaves_a_readable_run(tmp_path: Path) -> None:
    process = start(tmp_path, "run", "fast", *SMALL, "--output", "cut")
    log = tmp_path / "cut" / "log.jsonl"
    deadline_s = time.monotonic() + TIMEOUT_S
    while not (log.exists() and log.read_text().count("\n") >= 2):
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130, err
    assert "stopped after" in err
    metrics = json.loads((tmp_path / "cut" / "metrics.json").read_text())
    assert metrics["state"] == "interrupted"
    assert 2 <= metrics["frames"] < 150
    succeed(start(tmp_path, "eval", "cut"))
    again = json.loads((tmp_path / "cut" / "metrics.json").read_text())
    assert again["state"] == "interrupted"
    assert again["frames"] == metrics["frames"]
    assert again["psnr_db"] is None or again["psnr_db"] > 20  # a run that is stopped does not wait for its images
