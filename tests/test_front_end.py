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
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import inverse, se3_exp
from tgslam.map.keyframes import Keyframe
from tgslam.map.world import Map
from tgslam.tracking.doubt import Doubt, misfit
from tgslam.tracking.front_end import FrontEnd
from tgslam.tracking.hypotheses import best, recognised
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
    measures = {"depth_residual_sigmas": off_sigmas, "colour_residual_sigmas": 0.0, "agreement": agreement}
    return TrackingResult(at(x_m), Exposure(), np.eye(6), lost, "lost" if lost else "", measures)


def at(x_m: float) -> NDArray[np.float64]:
    return se3_exp([0, 0, 0, x_m, 0, 0])


# Which place is the right one


def test_what_is_off_by_less_is_the_place_and_nothing_else_counts() -> None:
    first, near, off = result(0.0, 1.0), result(0.3, 0.9), result(0.5, 2.0)
    assert best(first, [off, near]) is near
    assert best(first, [off]) is first
    assert best(first, [result(0.3, 0.97)]) is first  # hardly better: a blank wall fits everywhere alike
    assert best(first, [result(0.3, 0.1, lost=True)]) is first
    assert best(result(0.0, 0.1, lost=True), [off]) is off
    assert best(first, []) is first


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


@pytest.mark.parametrize("number", [45, 60])
def test_a_frame_is_recognised_from_the_latest_keyframe_that_shows_the_same(number: int) -> None:
    world, frame = world_of(300, 30), source().read(number)
    found = list(recognised(world.looks.of(frame.colour, frame.depth_m), world, anywhere=False))
    assert len(found) == 1
    error = found[0] @ source().pose(number)
    assert np.linalg.norm(error[:3, 3]) < 0.02 and np.linalg.norm(error[:3, :3] - np.eye(3)) < 0.02


def test_a_camera_that_was_carried_is_recognised_anywhere() -> None:
    world, frame = world_of(300, 30, 100, 150, 200), source().read(310)
    look = world.looks.of(frame.colour, frame.depth_m)
    assert not list(recognised(look, world, anywhere=False))
    (found,) = recognised(look, world, anywhere=True)
    assert np.linalg.norm((found @ source().pose(310))[:3, 3]) < 0.02


def test_what_no_keyframe_shows_is_not_recognised() -> None:
    world, frame = world_of(0, 20), source().read(360)
    assert not list(recognised(world.looks.of(frame.colour, frame.depth_m), world, anywhere=True))


# What the front end does with it


@dataclass
class FakeTracker:
    """Is lost but within 10 cm of one of `good`, where it goes; remembers what it was asked."""

    good: dict[float, float]  # x, and the misfit there
    asked: list[float] = field(default_factory=list)
    accepted: int = 0
    rasterizer: FakeTracker | None = None

    def __post_init__(self) -> None:
        self.rasterizer = self

    def forward(self, gaussians: object, T_cw: NDArray[np.float64]) -> None:
        """Renders nothing."""

    def accept(self, found: TrackingResult) -> None:
        self.accepted += 1

    def track(
        self, frame: object, gaussians: object, T_cw: NDArray[np.float64], exposure: Exposure, prior: object = None
    ) -> TrackingResult:
        x_m = float((T_cw @ source().pose(0))[0, 3])
        self.asked.append(round(x_m, 3))
        near = min(self.good, key=lambda place: abs(place - x_m), default=np.inf)
        if abs(near - x_m) > 0.1:
            return replace(result(0.0, 3.0, lost=True), T_cw=T_cw)
        return replace(result(0.0, self.good[near]), T_cw=at(near) @ inverse(source().pose(0)))


def tracked(good: dict[float, float], predicted_m: float, latest_m: float = 0.0) -> tuple[TrackingResult, FakeTracker]:
    """Of frame 0, which a keyframe shows as well, predicted somewhere along x."""
    front_end, fake = FrontEnd(source().camera, CONFIG.tracking, CONFIG.loss), FakeTracker(good)
    front_end.tracker = fake  # type: ignore[assignment]
    there = inverse(source().pose(0))
    front_end._motion.update(0.0, at(predicted_m) @ there, 1e12 * np.eye(6))
    frame = replace(source().read(0), timestamp_s=0.03)
    return front_end.track(frame, world_of(300, 0), at(latest_m) @ there), fake


def test_another_place_that_looks_the_same_and_fits_better_is_taken() -> None:
    found, fake = tracked({0.0: 0.5, 1.0: 1.0}, predicted_m=1.0)
    assert not found.lost and (found.T_cw @ source().pose(0))[0, 3] == pytest.approx(0.0, abs=1e-9)
    assert len(fake.asked) == 2 and fake.accepted == 1


def test_a_place_that_fits_no_better_is_not() -> None:
    found, _ = tracked({0.0: 1.0, 1.0: 0.9}, predicted_m=1.0)
    assert (found.T_cw @ source().pose(0))[0, 3] == pytest.approx(1.0)


def test_fallbacks_are_tried_until_one_holds() -> None:
    found, fake = tracked({0.5: 1.0}, predicted_m=1.0, latest_m=0.5)
    assert not found.lost and (found.T_cw @ source().pose(0))[0, 3] == pytest.approx(0.5)
    assert [fake.asked[0], fake.asked[-1]] == [1.0, 0.5]


def test_where_nothing_holds_the_camera_coasts_with_the_evidence_of_the_first_attempt() -> None:
    found, fake = tracked({}, predicted_m=1.0, latest_m=0.5)
    assert found.lost and found.message == "lost" and fake.accepted == 0
    assert (found.T_cw @ source().pose(0))[0, 3] == pytest.approx(1.0)
