"""The run loop: every frame in order, bad ones counted, everything saved on a stop, nothing whole after a failure."""

from __future__ import annotations

import json
import math
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.fakes import FakeSource, FakeSystem, fake_show, make_fake_show
from tgslam import pipeline
from tgslam.config.input_settings import EvaluationConfig
from tgslam.datasets.read_ahead import read_frames
from tgslam.errors import EvaluationError, FrameError, OutputError, TrackingError
from tgslam.evaluation.held_out import view_metrics
from tgslam.evaluation.protocol import IMAGE_KEYS, held_out_poses, is_held_out
from tgslam.evaluation.run_metrics import METRIC_KEYS, complete, evaluate_run
from tgslam.geometry import se3_exp
from tgslam.output.log import read_log, to_json
from tgslam.output.ply import read_map
from tgslam.output.run_folder import RunFolder
from tgslam.output.trajectory_io import read_trajectory
from tgslam.types import FrameReport, FrameStatus, Trajectory

RESULTS = {
    *("trajectory.txt", "keyframes.txt", "map.ply", "map_extra.npz", "log.jsonl"),
    *("planes.json", "planes.glb", "floorplan.svg", "map_planes.ply"),
}


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run", overwrite=False)


def names(folder: RunFolder) -> set[str]:
    return {path.name for path in folder.path.iterdir()}


@pytest.mark.parametrize("read_ahead", [False, True])
def test_every_frame_reaches_the_system_in_order(folder: RunFolder, read_ahead: bool) -> None:
    source, system, seen = FakeSource(12), FakeSystem(), []
    summary = pipeline.run(source, system, folder, read_ahead=read_ahead, observer=seen.append)
    assert [frame.index for frame in system.frames] == list(range(12))
    assert seen == summary.reports
    assert system.finished
    assert not summary.interrupted
    assert not source.groundtruth_asked
    assert names(folder) == RESULTS
    assert len(read_trajectory(folder.trajectory)) == 12
    assert len(read_trajectory(folder.keyframes)) == len(read_map(folder.map)) == 4


def test_the_next_frame_is_read_by_another_thread(folder: RunFolder) -> None:
    readers = set()

    class Watched(FakeSource):
        def read(self, index: int):
            readers.add(threading.current_thread().name)
            return super().read(index)

    pipeline.run(Watched(4), FakeSystem(), folder, read_ahead=True)
    assert threading.main_thread().name not in readers
    assert len(readers) == 1


def test_the_log_has_a_line_a_frame_in_plain_json(folder: RunFolder) -> None:
    summary = pipeline.run(FakeSource(5, bad=(2,)), FakeSystem(lost=(3,)), folder)
    lines = [json.loads(line) for line in folder.log.read_text().splitlines()]
    assert [line["status"] for line in lines] == ["initial", "tracked", "skipped", "lost", "tracked"]
    assert lines[1]["measures"] == {"residual": 0.5, "condition": None}
    assert lines[2]["message"] == "frame 2 is truncated"
    assert lines[2]["timestamp_s"] is None
    back = read_log(folder.log)
    assert back[1].index == summary.reports[1].index
    assert math.isnan(back[2].timestamp_s)
    assert back[3].status is FrameStatus.LOST


def test_the_log_of_a_killed_run_is_read_up_to_its_last_whole_line(tmp_path: Path) -> None:
    report = FrameReport(7, 0.5, FrameStatus.TRACKED, False, 3, {"track": 0.1}, {"a": 1.0}, "why")
    path = tmp_path / "log.jsonl"
    path.write_text(to_json(report) + "\n" + to_json(report)[:30])
    assert read_log(path) == [report]
    path.write_text("{}\n")
    with pytest.raises(OutputError, match=r"log\.jsonl:1: damaged"):
        read_log(path)


def test_bad_frames_are_skipped_and_counted(folder: RunFolder) -> None:
    summary = pipeline.run(FakeSource(12, bad=(1, 5)), FakeSystem(lost=(4,), refused=(8,)), folder)
    statuses = [report.status for report in summary.reports]
    assert [index for index, status in enumerate(statuses) if status is FrameStatus.SKIPPED] == [1, 5, 8]
    assert statuses.count(FrameStatus.LOST) == 1
    assert summary.reports[8].message == "frame 8 has no depth"
    assert summary.reports[8].timestamp_s == pytest.approx(0.8)
    assert len(read_trajectory(folder.trajectory)) == 9


@pytest.mark.parametrize(("bad", "lost"), [(tuple(range(6)), ()), ((), tuple(range(1, 6))), ((), tuple(range(6)))])
def test_a_run_without_any_tracked_frame_is_an_error(folder: RunFolder, bad: tuple, lost: tuple) -> None:
    with pytest.raises(TrackingError, match="none of 6 frames could be tracked"):
        pipeline.run(FakeSource(6, bad=bad), FakeSystem(lost=lost), folder)
    assert not names(folder) & {"trajectory.txt", "map.ply", "metrics.json"}


def test_a_request_to_stop_saves_what_is_there(folder: RunFolder) -> None:
    system = FakeSystem()
    summary = pipeline.run(FakeSource(12), system, folder, stop_requested=lambda: len(system.frames) == 7)
    assert summary.interrupted
    assert not system.finished
    assert names(folder) == RESULTS
    assert len(read_trajectory(folder.trajectory)) == len(read_log(folder.log)) == 7


def test_no_refinement_on_request(folder: RunFolder) -> None:
    system = FakeSystem()
    pipeline.run(FakeSource(3), system, folder, refine=False)
    assert not system.finished


@pytest.mark.parametrize("where", ["read", "process", "finish"])
def test_a_failure_leaves_nothing_that_looks_whole(folder: RunFolder, where: str) -> None:
    def fail(index: int = 5) -> None:
        if index == 5:
            raise RuntimeError("boom")

    system = FakeSystem(on_frame=fail if where == "process" else lambda index: None)
    if where == "finish":
        system.finish = fail
    with pytest.raises((RuntimeError, OSError)):
        pipeline.run(FakeSource(12, fails_at=5 if where == "read" else None), system, folder)
    assert names(folder) == {"log.jsonl", "partial_trajectory.txt", "partial_map.ply", "partial_map_extra.npz"}
    assert len(read_trajectory(folder.partial_trajectory)) == (12 if where == "finish" else 5)


def test_poses_that_cannot_be_written_do_not_take_the_map_with_them(folder: RunFolder) -> None:
    system = FakeSystem()
    system.trajectory = lambda: Trajectory(np.zeros(2), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(OutputError, match="timestamps do not increase"):
        pipeline.run(FakeSource(3), system, folder)
    assert names(folder) == {"log.jsonl", "partial_map.ply", "partial_map_extra.npz"}


def test_two_runs_write_the_same_bytes(tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        folder = RunFolder.create(tmp_path / name, overwrite=False)
        pipeline.run(FakeSource(), FakeSystem(), folder)
        paths = (folder.trajectory, folder.keyframes, folder.map, folder.planes, folder.planes_mesh, folder.floorplan)
        contents.append([path.read_bytes() for path in paths])
    assert contents[0] == contents[1]


def test_metrics_of_a_run(folder: RunFolder) -> None:
    source = FakeSource(12, bad=(1,))
    pipeline.run(source, FakeSystem(lost=(4,)), folder)
    metrics = complete(evaluate_run(folder, EvaluationConfig(), source, source.groundtruth(), make_fake_show))
    assert tuple(metrics) == METRIC_KEYS
    assert (metrics["frames"], metrics["frames_skipped"], metrics["frames_lost"]) == (12, 1, 1)
    assert metrics["tracked_fraction"] == pytest.approx(10 / 12)
    assert metrics["keyframes"] == metrics["gaussians"] == 4
    assert metrics["stage_s"] == {"track": 5.5, "map": 2.75}
    assert metrics["ate_rmse_cm"] == pytest.approx(0, abs=1e-6)
    assert metrics["rpe_rot_deg"] == pytest.approx(0, abs=1e-6)
    assert metrics["heldout_frames"] == 1  # of frames 4 and 9, the last is a keyframe
    assert metrics["psnr_db"] == pytest.approx(20, abs=1e-4)
    assert metrics["psnr_masked_db"] == pytest.approx(20, abs=1e-4)
    assert metrics["depth_l1_cm"] == pytest.approx(1, abs=1e-4)
    assert metrics["planes"] == 1
    assert metrics["plane_area_m2"] == pytest.approx(4)
    assert metrics["plane_rms_mm"] == pytest.approx(3)
    assert all(metrics[key] is None for key in ("closures", "lpips", "plane_pq", "plane_normal_deg", "floater_share"))


def test_metrics_that_do_not_apply_are_null(folder: RunFolder) -> None:
    source = FakeSource(2)
    pipeline.run(source, FakeSystem(), folder)
    metrics = complete(evaluate_run(folder, EvaluationConfig(), source, source.groundtruth(), make_fake_show))
    assert metrics["ate_rmse_cm"] is None
    assert metrics["psnr_db"] is None
    assert metrics["rpe_trans_cm"] == pytest.approx(0, abs=1e-6)
    without = complete(evaluate_run(folder, EvaluationConfig(), None, None, None))
    assert without["rpe_trans_cm"] is None


def test_an_input_that_has_shrunk_is_an_error(folder: RunFolder) -> None:
    pipeline.run(FakeSource(12), FakeSystem(), folder)
    with pytest.raises(EvaluationError, match="11 frames now, but this run saw 12"):
        evaluate_run(folder, EvaluationConfig(), FakeSource(11), None, make_fake_show)


def test_a_run_without_results_cannot_be_evaluated(folder: RunFolder) -> None:
    with pytest.raises(OutputError, match="did not come to its end"):
        evaluate_run(folder, EvaluationConfig(), None, None, None)


def test_held_out_frames_are_every_nth_by_frame_index() -> None:
    assert [index for index in range(12) if is_held_out(index, 5)] == [4, 9]

    def report(index: int, status: FrameStatus = FrameStatus.TRACKED, is_keyframe: bool = False) -> FrameReport:
        return FrameReport(index, 0.0, status, is_keyframe, 0, {}, {})

    poses = np.stack([np.eye(4) * i for i in range(4)])
    reports = [report(8), report(0, FrameStatus.SKIPPED), report(9), report(14, is_keyframe=True), report(19)]
    chosen = held_out_poses(reports, Trajectory(np.arange(4.0), poses), interval=5)
    assert [(position, T[0, 0]) for position, T in chosen] == [(2, 1.0), (4, 3.0)]
    with pytest.raises(EvaluationError, match="not of one run"):
        held_out_poses(reports, Trajectory(np.arange(3.0), poses[:3]), interval=5)


@pytest.mark.parametrize("read_ahead", [False, True])
def test_image_metrics_leave_out_what_cannot_be_read_and_stop_on_request(read_ahead: bool) -> None:
    poses = [(1, np.eye(4)), (2, np.eye(4))]
    metrics = view_metrics(FakeSource(4, bad=(1,)), poses, fake_show, read_ahead=read_ahead)
    assert metrics["heldout_frames"] == 1
    stopped = view_metrics(FakeSource(4), poses, fake_show, read_ahead=read_ahead, stop_requested=lambda: True)
    assert {stopped[key] for key in IMAGE_KEYS} == {None}


def test_a_held_out_frame_is_read_once_and_rendered_once() -> None:
    read, rendered = [], []

    class Counted(FakeSource):
        def read(self, index: int):
            read.append(index)
            return super().read(index)

    def show(T_cw):
        rendered.append(T_cw[0, 3])
        return fake_show(T_cw)

    poses = [(k, se3_exp([0.0, 0.0, 0.0, -float(k), 0.0, 0.0])) for k in (1, 2, 5)]
    metrics = view_metrics(Counted(6), poses, show, read_ahead=True)
    assert read == rendered == [1, 2, 5]
    assert metrics["heldout_frames"] == 3 and metrics["plane_surface_switches_per_100"] == 0


def test_an_image_that_cannot_be_scored_is_an_error() -> None:
    def broken(T_cw):
        rendering, ids = fake_show(T_cw)
        return replace(rendering, colour=np.full_like(rendering.colour, np.nan)), ids

    with pytest.raises(EvaluationError, match="NaN"):
        view_metrics(FakeSource(4), [(1, np.eye(4)), (2, np.eye(4))], broken)


def test_read_frames_passes_other_errors_on() -> None:
    for ahead in (False, True):
        items = read_frames(FakeSource(4, bad=(0,), fails_at=2), ahead)
        assert isinstance(next(items), FrameError)
        next(items)
        with pytest.raises(OSError, match="Input/output"):
            next(items)
        assert [frame.index for frame in read_frames(FakeSource(9), ahead, [2, 7, 3])] == [2, 7, 3]
        assert list(read_frames(FakeSource(9), ahead, [])) == []
