"""What a run's reports add up to, and that what is printed exists."""

from __future__ import annotations

from dataclasses import replace

from tgslam.cli.summary import LINES
from tgslam.evaluation.run_metrics import METRIC_KEYS, counts
from tgslam.types import FrameReport, FrameStatus


def test_every_line_of_the_summary_is_a_metric_once() -> None:
    keys = [key for _, key, _ in LINES]
    assert set(keys) <= set(METRIC_KEYS)
    assert len(set(keys)) == len(keys) == len({label for label, _, _ in LINES})
    # What is left out is no figure, or has one line for two
    assert set(METRIC_KEYS) - set(keys) == {"state", "device", "seed", "stage_s", "lpips"}


def test_closures_are_those_of_the_last_frame_that_was_used() -> None:
    tracked = FrameReport(0, 0.0, FrameStatus.TRACKED, True, 10, {}, {}, closures=3)
    skipped = replace(tracked, status=FrameStatus.SKIPPED, closures=None)
    assert counts([replace(tracked, closures=1), tracked, skipped])["closures"] == 3
    assert counts([skipped])["closures"] is None
    assert counts([])["closures"] is None
