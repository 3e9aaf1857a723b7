"""Metrics of planes from end to end: a scene of known labels and planes, and a system whose errors are known too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fakes import CAMERA, FakeSource, FakeSystem, fake_show, make_fake_show
from tests.test_plane_outputs import FLOOR, ROOM, turned
from tgslam import pipeline
from tgslam.config.input_settings import EvaluationConfig
from tgslam.datasets.source import FrameRange
from tgslam.evaluation.plane_metrics import (
    FLOATER_KEY,
    INSTANCE_KEYS,
    InstanceComparison,
    floater_share,
    plane_errors,
    summary_metrics,
)
from tgslam.evaluation.protocol import IMAGE_KEYS
from tgslam.evaluation.run_metrics import METRIC_KEYS, complete, evaluate_run
from tgslam.geometry import inverse, se3_exp
from tgslam.output.run_folder import RunFolder
from tgslam.types import Plane


class FakeTruth:
    """The wall of `FakeSystem` in the left half of every image, and at its right a plane that is too small."""

    def labels(self, index: int) -> np.ndarray:
        labels = np.full(CAMERA.shape, 1, np.int32)
        labels[:, : CAMERA.width // 2] = 0
        return labels

    def planes(self) -> np.ndarray:
        return np.array([[0.0, 0, -1, 2.01], [1.0, 0, 0, 3]])

    def seen_areas_m2(self, index: int) -> np.ndarray:
        return np.array([1.0 if index % 4 == 0 else 0.1, 0.15])

    def surface_distance_m(self, points_w: np.ndarray) -> np.ndarray:
        return np.abs(points_w[:, 2] - 2.0)


class KnownSource(FakeSource):
    """A `FakeSource` whose scene is known."""

    def truth(self) -> FakeTruth:
        return FakeTruth()


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run", overwrite=False)


def equations(planes: tuple[Plane, ...]) -> np.ndarray:
    return np.array([[*plane.normal_w, plane.offset_m] for plane in planes])


def test_metrics_of_a_run_in_a_known_scene(folder: RunFolder) -> None:
    source = KnownSource(12)
    pipeline.run(source, FakeSystem(), folder)
    found = evaluate_run(folder, EvaluationConfig(), source, source.groundtruth(), make_fake_show)
    metrics = complete(found)
    assert tuple(metrics) == METRIC_KEYS
    assert metrics["plane_pq"] == metrics["plane_frame_pq"] == metrics["plane_miou"] == 1
    assert metrics["plane_precision"] == metrics["plane_recall"] == 1
    assert metrics["plane_switches_per_100"] == 0
    assert metrics["plane_normal_deg"] == pytest.approx(0, abs=1e-4)
    assert metrics["plane_offset_mm"] == pytest.approx(10, abs=0.01)
    assert metrics["floater_share"] == 0


def test_without_a_known_scene_a_map_that_is_shown_or_planes_instance_metrics_are_null(folder: RunFolder) -> None:
    known, unknown, system = KnownSource(12), FakeSource(12), FakeSystem()
    pipeline.run(known, system, folder)

    def instance_values(source: FakeSource | None, make_show=make_fake_show) -> set:
        metrics = complete(evaluate_run(folder, EvaluationConfig(), source, None, make_show))
        assert metrics["planes"] == len(system.planes())
        return {metrics[key] for key in INSTANCE_KEYS}

    assert None not in instance_values(known)
    assert instance_values(unknown) == instance_values(None) == instance_values(known, None) == {None}
    system.planes = lambda: ()
    folder.write_planes((), system.gaussians())
    assert instance_values(known) == {None}


def test_a_run_of_an_earlier_version_has_no_plane_metrics(folder: RunFolder) -> None:
    source = KnownSource(12)
    pipeline.run(source, FakeSystem(), folder)
    folder.planes.unlink()
    metrics = complete(evaluate_run(folder, EvaluationConfig(), source, None, make_fake_show))
    assert metrics["planes"] is metrics["plane_area_m2"] is metrics["plane_pq"] is None
    assert metrics[FLOATER_KEY] == 0


def test_labels_follow_the_frames_of_a_range(folder: RunFolder) -> None:
    class Numbered(FakeTruth):
        def labels(self, index: int) -> np.ndarray:
            return np.full((2, 2), index, np.int32)

    class NumberedSource(KnownSource):
        def truth(self) -> FakeTruth:
            return Numbered()

    truth = FrameRange(NumberedSource(12), 3, None, 2).truth()
    assert [truth.labels(i)[0, 0] for i in range(3)] == [3, 5, 7]
    assert len(truth.planes()) == len(truth.seen_areas_m2(0)) == 2
    assert truth.surface_distance_m(np.zeros((1, 3))) == 2
    assert FrameRange(FakeSource(12), 3).truth() is None


def test_instance_metrics_add_up_over_frames() -> None:
    comparison, planes = InstanceComparison(FakeTruth()), FakeSystem().planes()
    assert comparison.metrics(planes, np.eye(4)) == dict.fromkeys(INSTANCE_KEYS)
    for position, id_ in enumerate((4, 4, 6, 4)):
        _, ids = fake_show(np.eye(4))
        comparison.add(position, np.where(ids == 4, np.int32(id_), np.int32(-1)))
    metrics = comparison.metrics(planes, None)
    assert set(metrics) == set(INSTANCE_KEYS)
    assert metrics["plane_frame_pq"] == 1
    assert metrics["plane_pq"] == pytest.approx(0.75 / 1.5)
    assert metrics["plane_switches_per_100"] == 50
    assert metrics["plane_normal_deg"] is None  # without an alignment


def test_planes_are_not_compared_on_a_request_to_stop(folder: RunFolder) -> None:
    source, answers = KnownSource(60), iter([False, True, True])
    pipeline.run(source, FakeSystem(), folder)
    stopped = complete(
        evaluate_run(
            folder, EvaluationConfig(), source, None, make_fake_show, stop_requested=lambda: next(answers, True)
        )
    )
    assert {stopped[key] for key in (*INSTANCE_KEYS, *IMAGE_KEYS, FLOATER_KEY)} == {None}


def test_what_a_run_says_of_its_planes() -> None:
    planes = (replace(FLOOR, area_m2=1.0, inlier_rms_m=0.002), replace(FLOOR, area_m2=3.0, inlier_rms_m=0.004))
    metrics = summary_metrics(planes)
    assert (metrics["planes"], metrics["plane_area_m2"]) == (2, 4)
    assert metrics["plane_rms_mm"] == pytest.approx(np.sqrt((4 + 3 * 16) / 4))
    assert summary_metrics(()) == {"planes": 0, "plane_area_m2": None, "plane_rms_mm": None}


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_plane_errors_do_not_depend_on_the_estimates_world(xi: list[float]) -> None:
    T = se3_exp(xi)  # true world to the estimate's
    planes = tuple(moved(one, T) for one in ROOM)
    errors = plane_errors(planes, {0: 3, 1: 5, 2: 7}, equations(ROOM), inverse(T))
    assert errors["plane_normal_deg"] == pytest.approx(0, abs=1e-6)
    assert errors["plane_offset_mm"] == pytest.approx(0, abs=1e-6)


def moved(one: Plane, T: np.ndarray) -> Plane:
    other = turned(one, T[:3, :3])
    centroid_w = other.centroid_w + T[:3, 3]
    return replace(other, centroid_w=centroid_w, offset_m=float(-other.normal_w @ centroid_w))


def test_plane_errors_of_known_size() -> None:
    angle = np.deg2rad(2.0)
    tilt = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    floor = replace(FLOOR, normal_w=tilt @ FLOOR.normal_w, centroid_w=FLOOR.centroid_w + np.array([0.5, 0.03, 0.7]))
    planes = (ROOM[0], ROOM[1], floor)
    errors = plane_errors(planes, {0: 3, 1: 5, 2: 7, 3: 99}, equations((*ROOM, FLOOR)), np.eye(4))
    assert errors["plane_normal_deg"] == pytest.approx(2 / 3)
    assert errors["plane_normal_p95_deg"] == pytest.approx(1.8)
    assert errors["plane_offset_mm"] == pytest.approx(10)
    flipped = plane_errors([replace(FLOOR, normal_w=-FLOOR.normal_w)], {0: 7}, equations((FLOOR,)), np.eye(4))
    assert flipped["plane_normal_deg"] == pytest.approx(180)  # the wrong side of a wall is another plane
    assert set(plane_errors(planes, {}, equations(ROOM), np.eye(4)).values()) == {None}


def test_floaters_are_counted_in_the_true_world() -> None:
    system = FakeSystem()
    system.keyframes = [FakeSource().read(index) for index in range(4)]
    gaussians = system.gaussians()
    heights = np.array([2.0, 2.04, 2.06, 1.5], np.float32)
    gaussians = replace(gaussians, mean=np.column_stack([np.ones((4, 2), np.float32), heights]))
    assert floater_share(gaussians, FakeTruth(), np.eye(4)) == 0.5
    lifted = np.eye(4)
    lifted[2, 3] = 0.5
    assert floater_share(gaussians, FakeTruth(), lifted) == 0.75
    assert floater_share(FakeSystem().gaussians(), FakeTruth(), np.eye(4)) is None
