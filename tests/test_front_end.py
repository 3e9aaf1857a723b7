"""Where a frame is looked for: from where motion leads, at places that look the same, and at the latest keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.schema import Config
from tgslam.config.tracking_settings import TrackingConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import inverse, se3_exp
from tgslam.map.keyframes import Keyframe
from tgslam.map.world import Map
from tgslam.tracking.doubt import Doubt, misfit
from tgslam.tracking.front_end import FrontEnd
from tgslam.tracking.hypotheses import Place, Sighted, recognised
from tgslam.tracking.result import TrackingResult
from tgslam.types import Exposure

CONFIG = Config()
NOISE = CONFIG.loss.noise


@cache
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", width=320, height=240, frames=720), seed=0)


@cache
def world_of(*numbers: int) -> Map:
    """Frames of the room as keyframes at their true poses; there are no Gaussians."""
    world = Map(source().camera, NOISE, CONFIG.loops)
    for number in numbers:
        frame = source().read(number)
        world.keyframes.add(Keyframe(frame, inverse(source().pose(number)), Exposure(), np.eye(6)))
        world.looks.add(world.looks.of(frame.colour, frame.depth_m))
    return world


def result(x_m: float, off_sigmas: float = 1.0, *, lost: bool = False, agreement: float = 1.0) -> TrackingResult:
    """A camera at -x, with what meets the map off by so much."""
    measures = {
        "depth_residual_sigmas": off_sigmas,
        "colour_residual_sigmas": 0.0,
        "agreement": agreement,
        "overlap": 1.0,
    }
    return TrackingResult(at(x_m), Exposure(), np.eye(6), lost, "lost" if lost else "", measures)


def at(x_m: float) -> NDArray[np.float64]:
    return se3_exp([0, 0, 0, x_m, 0, 0])


# Whether a pose is the place where a frame was recognised


def test_a_pose_agrees_within_what_features_may_be_off_by() -> None:
    place = Place(at(1.0), np.diag([1e6] * 3 + [0.005**-2] * 3))
    assert place.agrees(at(1.0)) and place.agrees(at(1.01))
    assert not place.agrees(at(1.05))
    assert not place.agrees(se3_exp([0.01, 0, 0, 1.0, 0, 0]))


def test_depth_that_does_not_match_at_all_is_off_too() -> None:
    assert misfit(result(0.0, 0.5, agreement=0.5)) > misfit(result(0.0, 1.0))


# When there is doubt

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)


def doubt_after(off_m: list[float]) -> Doubt:
    """Of a camera whose predictions were off by so much, 2 m from a wall."""
    doubt = Doubt(CAMERA, CAMERA.halved(3))
    for each in off_m:
        doubt.settle(result(each), np.eye(4), 2.0)
    return doubt


def test_in_the_beginning_all_is_in_doubt() -> None:
    assert doubt_after([]).about(result(0.0), np.eye(4), 2.0)


def test_a_camera_that_does_as_predicted_is_believed() -> None:
    doubt = doubt_after([0.005] * 5)
    assert not doubt.about(result(0.005), np.eye(4), 2.0)
    assert doubt.about(result(0.2), np.eye(4), 2.0)  # 50 px
    assert doubt.about(result(0.0, 2.0), np.eye(4), 2.0)
    assert doubt.about(result(0.0, lost=True), np.eye(4), 2.0)
    doubt.forget()
    assert doubt.about(result(0.005), np.eye(4), 2.0)


def test_predictions_that_were_off_are_remembered_for_a_while() -> None:
    assert doubt_after([0.005] * 5 + [0.1]).about(result(0.005), np.eye(4), 2.0)
    assert not doubt_after([0.005] * 5 + [0.1] + [0.005] * 10).about(result(0.005), np.eye(4), 2.0)


# Where the frame may be


def error_m(place: Place | None, number: int) -> float:
    assert place is not None
    return float(np.linalg.norm((place.T_cw @ source().pose(number))[:3, 3]))


@pytest.mark.parametrize("number", [45, 60])
def test_a_frame_is_recognised_from_the_latest_keyframe_that_shows_the_same(number: int) -> None:
    world, frame = world_of(300, 30), source().read(number)
    place = recognised(world.looks.of(frame.colour, frame.depth_m), world, None, anywhere=False)
    assert error_m(place, number) < 0.02
    assert place is not None and place.agrees(inverse(source().pose(number)))


def test_the_previous_frame_comes_first() -> None:
    """It shows more of the same than keyframes do; here it is said to have been elsewhere."""
    world, before, frame = world_of(300, 30), source().read(58), source().read(60)
    previous = Sighted(world.looks.of(before.colour, before.depth_m), at(5.0) @ inverse(source().pose(58)))
    place = recognised(world.looks.of(frame.colour, frame.depth_m), world, previous, anywhere=False)
    assert place is not None
    expected = inverse(source().pose(60)) @ source().pose(58) @ previous.T_cw
    assert np.linalg.norm((place.T_cw @ inverse(expected))[:3, 3]) < 0.02


def test_a_camera_that_was_carried_is_recognised_anywhere() -> None:
    world, frame = world_of(300, 30, 100, 150, 200), source().read(310)
    look = world.looks.of(frame.colour, frame.depth_m)
    assert recognised(look, world, None, anywhere=False) is None
    assert error_m(recognised(look, world, None, anywhere=True), 310) < 0.02


def test_what_no_keyframe_shows_is_not_recognised() -> None:
    world, frame = world_of(0, 20), source().read(360)
    assert recognised(world.looks.of(frame.colour, frame.depth_m), world, None, anywhere=True) is None


# What the front end does with it


@dataclass
class FakeTracker:
    """Goes to where it is drawn from within 30 cm, else it is lost; remembers what it was asked."""

    drawn_to: list[float]  # x
    asked: list[float] = field(default_factory=list)
    assessed: list[float] = field(default_factory=list)
    accepted: int = 0
    rasterizer: FakeTracker | None = None

    def __post_init__(self) -> None:
        self.rasterizer = self

    def forward(self, gaussians: object, T_cw: NDArray[np.float64]) -> None:
        """Renders nothing."""

    def accept(self, found: TrackingResult) -> None:
        self.accepted += 1

    def track(
        self,
        frame: object,
        gaussians: object,
        T_cw: NDArray[np.float64],
        exposure: Exposure,
        prior: object = None,
        firm: bool = False,
    ) -> TrackingResult:
        self.asked.append(round(x_of(T_cw), 2))
        ends = [x for x in self.drawn_to if abs(x - x_of(T_cw)) < 0.3]
        if not ends:
            return replace(result(0.0, 3.0, lost=True), T_cw=T_cw)
        return replace(result(0.0), T_cw=at(ends[0]) @ inverse(source().pose(0)))

    def assess(self, frame: object, gaussians: object, T_cw: NDArray[np.float64], exposure: Exposure) -> TrackingResult:
        self.assessed.append(round(x_of(T_cw), 2))
        return replace(result(0.0), T_cw=T_cw)


def x_of(T_cw: NDArray[np.float64]) -> float:
    return float((T_cw @ source().pose(0))[0, 3])


def tracked(
    drawn_to: list[float],
    predicted_m: float,
    latest_m: float = 0.0,
    number: int = 0,
    tracking: TrackingConfig = CONFIG.tracking,
) -> tuple[TrackingResult, FakeTracker]:
    """Of a frame that is predicted somewhere along x; a keyframe shows frame 0, where x is 0."""
    front_end, fake = FrontEnd(source().camera, tracking, CONFIG.loss, CONFIG.poses), FakeTracker(drawn_to)
    front_end.tracker = fake  # type: ignore[assignment]
    there = inverse(source().pose(0))
    front_end._motion.update(0.0, at(predicted_m) @ there, 1e12 * np.eye(6))
    frame = replace(source().read(number), timestamp_s=0.03)
    return front_end.track(frame, world_of(300, 0), at(latest_m) @ there), fake


def test_a_frame_that_is_recognised_where_it_was_aligned_stays() -> None:
    found, fake = tracked([0.001], predicted_m=0.1)
    assert not found.lost and x_of(found.T_cw) == pytest.approx(0.001)
    assert fake.asked == [0.1] and fake.accepted == 1


@pytest.mark.parametrize("first", [[1.0], []])
def test_a_frame_that_is_recognised_elsewhere_is_aligned_there(first: list[float]) -> None:
    found, fake = tracked([*first, 0.001], predicted_m=1.0)
    assert not found.lost and x_of(found.T_cw) == pytest.approx(0.001)
    assert fake.asked == [1.0, 0.0] and fake.accepted == 1


def test_where_alignment_leads_away_from_the_place_the_frame_is_there_all_the_same() -> None:
    found, fake = tracked([1.0, 0.2], predicted_m=1.0)
    assert not found.lost and x_of(found.T_cw) == pytest.approx(0.0, abs=0.01)
    assert fake.assessed == [0.0] and fake.accepted == 1
    assert found.information[3, 3] < 1e6  # what features say, not what alignment would


def test_a_frame_that_nothing_is_recognised_in_is_as_aligned() -> None:
    found, _ = tracked([1.0], predicted_m=1.0, number=540)
    assert not found.lost and x_of(found.T_cw) == pytest.approx(1.0)


def test_without_recognition_a_frame_is_as_aligned() -> None:
    found, fake = tracked([1.0, 0.001], predicted_m=1.0, tracking=replace(CONFIG.tracking, recognition=False))
    assert not found.lost and x_of(found.T_cw) == pytest.approx(1.0)
    assert fake.asked == [1.0] and fake.accepted == 1


def test_fallbacks_are_tried_until_one_holds() -> None:
    found, fake = tracked([0.5], predicted_m=1.0, latest_m=0.5, number=540)
    assert not found.lost and x_of(found.T_cw) == pytest.approx(0.5)
    assert fake.asked == [1.0, 0.5]


def test_where_nothing_holds_the_camera_coasts_with_the_evidence_of_the_first_attempt() -> None:
    found, fake = tracked([], predicted_m=1.0, latest_m=0.5, number=540)
    assert found.lost and found.message == "lost" and fake.accepted == 0
    assert x_of(found.T_cw) == pytest.approx(1.0)


def test_after_lost_frames_alignment_alone_has_to_be_convincing() -> None:
    """A piece of wall meets some piece of the map from almost anywhere."""
    doubt = Doubt(CAMERA, CAMERA.halved(2))
    for _ in range(5):
        doubt.settle(result(0.0), at(0.0), 1.0)
    good = result(0.0)
    little = replace(good, measures={**good.measures, "overlap": 0.3})
    assert doubt.convincing(good) and not doubt.convincing(little)
    assert not doubt.convincing(result(0.0, agreement=0.4)) and not doubt.convincing(result(0.0, lost=True))
    assert not doubt.convincing(result(0.0, 2.0))  # that far off is unusual
    assert not doubt.lost
    doubt.forget()
    assert doubt.lost
