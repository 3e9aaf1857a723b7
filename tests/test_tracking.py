"""Tracking with known truth: both solvers, exposure, information, lost frames, recovery and prediction."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from tests.mapper import Mapper
from tests.reference import alignment as reference
from tests.tiers import changed
from tgslam.camera import Camera
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.map_settings import LossConfig
from tgslam.config.schema import Config
from tgslam.config.tracking_settings import LostSettings, ModelSettings, MotionSettings, TrackingConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.device import runtime
from tgslam.geometry import inverse, se3_exp, se3_log
from tgslam.kernels import alignment
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.rasterize import RenderImages
from tgslam.tracking.exposure import IntensityMoments, fit_exposure
from tgslam.tracking.first_order import FirstOrderTracker
from tgslam.tracking.gauss_newton import GaussNewtonTracker
from tgslam.tracking.lost import LostDetector
from tgslam.tracking.motion import MotionFilter, unopposed
from tgslam.tracking.pyramid import LiveLevel, LivePyramid, ModelLevel, ModelPyramid, finest_level
from tgslam.tracking.references import NO_PLANES, Reference, references_of
from tgslam.tracking.solver import make_tracker
from tgslam.types import Exposure, Frame

CONFIG = TrackingConfig()
RESIDUALS, HANDS = CONFIG.expert.residuals, MotionSettings()
PATIENT = changed(CONFIG, solver="first_order", adam_steps=(60, 60), adam_rate=0.002)
CASES = [("room", 30), ("room", 120), ("blank", 30), ("blank", 120)]


@cache
def source(scene: str, noise: bool = False) -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene=scene, width=160, height=120, frames=700, noise=noise), 0)


@cache
def map_of(scene: str, index: int, noise: bool = False) -> GaussianMap:
    """A map of one frame, refined until the error of tracking against it is tracking's own."""
    config, one = Config(), source(scene, noise)
    mapping = replace(config.mapping, iterations=60)
    mapper = Mapper(one.camera, mapping, loss=config.loss, seeding=config.seeding)
    mapper.add(one.read(index), inverse(one.pose(index)))
    return mapper.gaussians


@cache
def tracker(config: TrackingConfig = CONFIG) -> GaussNewtonTracker | FirstOrderTracker:
    return make_tracker(source("room").camera, config, LossConfig())


def error(T_cw: np.ndarray, T_wc: np.ndarray) -> tuple[float, float]:
    """Angle in degrees and distance in mm."""
    rest = T_cw @ T_wc
    return float(np.rad2deg(np.linalg.norm(se3_log(rest)[:3]))), 1000.0 * float(np.linalg.norm(rest[:3, 3]))


def off_by(angle_deg: float, distance_m: float, seed: int) -> np.ndarray:
    """A motion of that size in a random direction."""
    ways = np.random.default_rng(seed).normal(size=(2, 3))
    turn, move = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    return se3_exp(np.concatenate([np.deg2rad(angle_deg) * turn, distance_m * move]))


# --- pose against the truth ---


@pytest.mark.parametrize(("scene", "index"), CASES)
@pytest.mark.parametrize("noise", [False, True])
def test_gauss_newton_finds_the_next_frames(scene, index, noise):
    """From the pose of the mapped frame; they are up to 2 degrees and 18 mm away. Noise: 1 sigma is 6 mm at 2 m."""
    one, gaussians = source(scene, noise), map_of(scene, index, noise)
    limit_deg, limit_mm = (0.1, 2.5) if noise else (0.03, 1.0)
    for k in (1, 2, 3):
        result = tracker().track(one.read(index + k), gaussians, inverse(one.pose(index)), Exposure())
        angle_deg, distance_mm = error(result.T_cw, one.pose(index + k))
        assert not result.lost, result.message
        assert angle_deg < limit_deg and distance_mm < limit_mm
        assert np.linalg.det(result.T_cw[:3, :3]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("scene", ["room", "blank"])
@pytest.mark.parametrize("noise", [False, True])
def test_first_order_finds_the_next_frames_given_time(scene, noise):
    one, gaussians = source(scene, noise), map_of(scene, 30, noise)
    for k in (1, 3):
        result = tracker(PATIENT).track(one.read(30 + k), gaussians, inverse(one.pose(30)), Exposure())
        angle_deg, distance_mm = error(result.T_cw, one.pose(30 + k))
        assert not result.lost, result.message
        assert angle_deg < (0.25 if noise else 0.15) and distance_mm < (6.0 if noise else 4.0)


def test_first_order_with_default_steps_gains_on_the_prediction():
    one, gaussians = source("room"), map_of("room", 30)
    config = changed(CONFIG, solver="first_order")
    result = tracker(config).track(one.read(32), gaussians, inverse(one.pose(30)), Exposure())
    assert error(result.T_cw, one.pose(32))[0] < 0.5 * error(inverse(one.pose(30)), one.pose(32))[0]


@pytest.mark.parametrize(("scene", "index"), CASES[:3])
def test_gauss_newton_converges_from_two_degrees_and_three_centimetres(scene, index):
    one, gaussians = source(scene), map_of(scene, index)
    for seed in range(6):
        start = off_by(2.0, 0.03, seed) @ inverse(one.pose(index + 2))
        result = tracker().track(one.read(index + 2), gaussians, start, Exposure())
        angle_deg, distance_mm = error(result.T_cw, one.pose(index + 2))
        assert not result.lost and angle_deg < 0.05 and distance_mm < 2.5, seed


def test_first_order_converges_from_one_degree_and_a_centimetre():
    one, gaussians = source("room"), map_of("room", 30)
    for seed in range(3):
        start = off_by(1.0, 0.01, seed) @ inverse(one.pose(32))
        result = tracker(PATIENT).track(one.read(32), gaussians, start, Exposure())
        angle_deg, distance_mm = error(result.T_cw, one.pose(32))
        assert angle_deg < 0.2 and distance_mm < 5.0, seed


def test_another_render_at_the_estimate_does_no_harm():
    one, gaussians = source("room"), map_of("room", 30)
    start = off_by(2.0, 0.03, 0) @ inverse(one.pose(32))
    twice = tracker(changed(CONFIG, renders=2)).track(one.read(32), gaussians, start, Exposure())
    angle_deg, distance_mm = error(twice.T_cw, one.pose(32))
    assert angle_deg < 0.05 and distance_mm < 1.5


@pytest.mark.parametrize("config", [CONFIG, changed(CONFIG, solver="first_order")])
def test_tracking_repeats_bit_for_bit(config):
    one, gaussians = source("room", True), map_of("room", 30, True)
    first, again = (
        make_tracker(one.camera, config, LossConfig()).track(one.read(32), gaussians, inverse(one.pose(30)), Exposure())
        for _ in range(2)
    )
    assert first.T_cw.tobytes() == again.T_cw.tobytes()
    assert first.information.tobytes() == again.information.tobytes()
    assert first.exposure == again.exposure and first.measures == again.measures


def test_large_images_are_aligned_at_a_lower_resolution():
    camera = source("room").camera
    assert [finest_level(camera, width) for width in (1000, 160, 159, 80, 79)] == [0, 0, 1, 1, 2]
    large = Camera(2 * TINY.width, 2 * TINY.height, 2 * TINY.fx, 2 * TINY.fy, 2 * TINY.cx + 0.5, 2 * TINY.cy + 0.5)
    assert large.halved() == TINY
    scene = Planes((WALL, SIDE, FLOOR), 0.3, large)
    half = exact_tracker(scene, changed(CONFIG, finest_width_px=TINY.width))
    result = half.track(scene.frame(MOTION), None, np.eye(4), Exposure())
    angle_deg, distance_mm = error(result.T_cw, inverse(MOTION))
    assert not result.lost and angle_deg < 0.03 and distance_mm < 1.5


@pytest.mark.parametrize("scene", ["room", "blank"])
def test_a_lower_resolution_does_not_draw_the_pose(scene):
    """Splats rendered small reach over edges; rendered at full size they do not."""
    one, gaussians = source(scene), map_of(scene, 30)
    half = tracker(changed(CONFIG, finest_width_px=80, alignment_steps=(6, 8)))
    result = half.track(one.read(32), gaussians, inverse(one.pose(30)), Exposure())
    angle_deg, distance_mm = error(result.T_cw, one.pose(32))
    assert not result.lost and angle_deg < 0.05 and distance_mm < 2.0


# --- exposure ---


def with_exposure(frame: Frame, gain: float, bias: float = 0.0) -> Frame:
    return replace(frame, colour=frame.colour * np.float32(gain) + np.float32(bias))


@pytest.mark.parametrize("gain", [0.8, 1.25])
def test_the_gain_of_a_frame_is_found_and_the_pose_does_not_suffer(gain):
    one, gaussians = source("room"), map_of("room", 30)
    frame = with_exposure(one.read(32), gain)
    result = tracker().track(frame, gaussians, inverse(one.pose(30)), Exposure())
    assert result.exposure.gain == pytest.approx(1.0 / gain, rel=2e-3) and result.exposure.bias == 0.0
    angle_deg, distance_mm = error(result.T_cw, one.pose(32))
    assert angle_deg < 0.03 and distance_mm < 1.0
    assert result.measures["gain"] == result.exposure.gain


def test_gain_and_bias_are_found_together():
    """Up to what a rendered model's lost contrast adds to both, which a frame of gain 1 shows."""
    one, gaussians = source("room"), map_of("room", 30)
    both, start = tracker(changed(CONFIG, exposure="gain_bias")), inverse(one.pose(30))
    plain = both.track(one.read(32), gaussians, start, Exposure()).exposure
    assert plain.gain == pytest.approx(1.0, abs=0.04) and plain.bias == pytest.approx(0.0, abs=0.02)
    dimmed = both.track(with_exposure(one.read(32), 0.8, 0.05), gaussians, start, Exposure()).exposure
    assert dimmed.gain == pytest.approx(plain.gain / 0.8, rel=2e-3)
    assert dimmed.bias == pytest.approx(plain.bias - plain.gain / 0.8 * 0.05, abs=2e-3)


@pytest.mark.parametrize("solver", ["gauss_newton", "first_order"])
@pytest.mark.parametrize("model", ["none", "gain", "gain_bias"])
def test_only_what_the_exposure_model_names_is_fitted(solver, model):
    one, gaussians = source("room"), map_of("room", 30)
    config = changed(CONFIG, solver=solver, exposure=model)
    frame = with_exposure(one.read(31), 0.95, 0.02)
    found = tracker(config).track(frame, gaussians, inverse(one.pose(30)), Exposure()).exposure
    assert (found.gain != 1.0) == (model != "none")
    assert (found.bias != 0.0) == (model == "gain_bias")


def moments(live: np.ndarray, model: np.ndarray) -> IntensityMoments:
    return IntensityMoments(*(float(x) for x in (live.size, live.sum(), model.sum(), live @ live, live @ model)))


LIVE = np.random.default_rng(0).uniform(0.2, 0.8, 1000)
OTHER = Exposure(1.3, -0.1)


def test_fits_are_exact_where_the_model_holds():
    assert fit_exposure(moments(LIVE, 1.4 * LIVE), "gain", OTHER).gain == pytest.approx(1.4, rel=1e-12)
    both = fit_exposure(moments(LIVE, 1.4 * LIVE - 0.1), "gain_bias", OTHER)
    assert both.gain == pytest.approx(1.4, rel=1e-9) and both.bias == pytest.approx(-0.1, rel=1e-8)
    assert fit_exposure(moments(LIVE, 1.4 * LIVE), "none", OTHER) == Exposure(1.0, 0.0)


def test_blur_of_the_model_shows_in_gain_bias_and_not_in_gain():
    """Half of the contrast is lost about the same mean."""
    blurred = LIVE.mean() + 0.5 * (LIVE - LIVE.mean())
    assert fit_exposure(moments(LIVE, blurred), "gain", OTHER).gain == pytest.approx(1.0, rel=1e-12)
    both = fit_exposure(moments(LIVE, blurred), "gain_bias", OTHER)
    assert both.gain == pytest.approx(0.5) and both.bias == pytest.approx(0.5 * LIVE.mean())


@pytest.mark.parametrize("model", ["gain", "gain_bias"])
def test_undetermined_exposures_stay_what_they_were(model):
    black = np.full(1000, 1e-5)
    for live, rendered in ((LIVE[:0], LIVE[:0]), (black, LIVE), (LIVE, black)):
        assert fit_exposure(moments(live, rendered), model, OTHER) == OTHER


def test_one_intensity_determines_a_gain_only():
    grey = np.full(1000, 0.5)
    assert fit_exposure(moments(grey, 0.6 * grey / 0.5), "gain_bias", OTHER) == Exposure(pytest.approx(1.2), 0.0)


@pytest.mark.parametrize("slope", [-0.5, 0.01, 20.0])
def test_an_absurd_contrast_is_no_exposure(slope):
    rendered = 0.5 + slope * (LIVE - LIVE.mean())
    assert fit_exposure(moments(LIVE, rendered), "gain_bias", OTHER) == OTHER


# --- information, on scenes that are rendered exactly from any pose ---

TINY, LARGE = Camera(64, 48, 50.0, 50.0, 31.5, 23.5), Camera(320, 240, 250.0, 250.0, 159.5, 119.5)
WALL, SIDE, FLOOR = ((0.1, 0.05, -1.0), 3.0), ((-1.0, 0.0, 0.0), 1.2), ((0.0, -1.0, 0.0), 0.8)


@dataclass
class Planes:
    """Planes (normal, offset) with smooth intensities; stands in for a rasterizer, as a map without any error."""

    planes: tuple
    contrast: float = 0.0
    camera: Camera = TINY

    def images(self, T_cw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        rays = np.stack([(u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fy, 1.0 + 0 * u], -1)
        z = np.full(u.shape, np.inf)
        for normal, offset in self.planes:
            n_c = T_cw[:3, :3] @ np.array(normal) / np.linalg.norm(normal)
            depth = -(offset / np.linalg.norm(normal) - n_c @ T_cw[:3, 3]) / (rays @ n_c)
            z = np.minimum(z, np.where(depth > 0, depth, np.inf))
        z[np.isinf(z)] = 0.0  # what meets no plane has no depth
        T_wc = inverse(T_cw)
        x, y, w = np.moveaxis((rays * z[..., None]) @ T_wc[:3, :3].T + T_wc[:3, 3], -1, 0)
        grey = 0.5 + self.contrast * (np.sin(3.0 * x + 1.0) + np.cos(4.0 * y) + np.sin(2.5 * w + x)) / 3
        return grey.astype(np.float32), z.astype(np.float32)

    def frame(self, T_cw: np.ndarray) -> Frame:
        grey, depth_m = self.images(T_cw)
        return Frame(0, 0.0, np.repeat(grey[..., None], 3, axis=2), depth_m)

    def forward(self, gaussians: GaussianMap | None, T_cw: np.ndarray) -> RenderImages:
        frame = self.frame(T_cw)
        images = (frame.colour, frame.depth_m, np.ones_like(frame.depth_m), np.zeros_like(frame.colour))
        return RenderImages(*(runtime.to_device(image) for image in images))


def exact_tracker(scene: Planes, config: TrackingConfig = CONFIG) -> GaussNewtonTracker:
    result = GaussNewtonTracker(scene.camera, config, LossConfig())
    result.rasterizer = scene
    return result


MOTION = se3_exp([0.005, -0.01, 0.004, 0.01, 0.004, -0.006])


class Rippled(Planes):
    """The rendered depth strays from the planes by a millimetre or two, as splats make it."""

    def forward(self, gaussians: GaussianMap | None, T_cw: np.ndarray) -> RenderImages:
        frame = self.frame(T_cw)
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        depth_m = frame.depth_m + np.float32(0.0015) * np.sin(0.7 * u + 0.5 * v).astype(np.float32)
        images = (frame.colour, depth_m, np.ones_like(depth_m), np.zeros_like(frame.colour))
        return RenderImages(*(runtime.to_device(image) for image in images))


WALL_NORMAL = np.array(WALL[0]) / np.linalg.norm(WALL[0])
WALL_PLANE = np.array([[*WALL_NORMAL, WALL[1] / np.linalg.norm(WALL[0])]])  # in the world


def held_along_the_wall(tracker: GaussNewtonTracker, scene: Planes) -> float:
    """Information on the camera's place along the wall, which is in plain view; and the distance from it is right."""
    along = np.array([0.0, 0.0, 0.0, *np.cross(WALL_NORMAL, [0.0, 1.0, 0.0])])
    result = tracker.track(scene.frame(MOTION), None, np.eye(4), Exposure())
    assert abs(WALL_NORMAL @ (inverse(result.T_cw) - inverse(MOTION))[:3, 3]) < 5e-4
    information = tracker.track(scene.frame(np.eye(4)), None, np.eye(4), Exposure()).information
    return float(along @ information @ along)


def test_ripples_on_a_known_plane_do_not_hold_the_camera_along_it():
    scene = Rippled((WALL,), camera=LARGE)
    unknown, known = exact_tracker(scene), exact_tracker(scene)
    known.know(WALL_PLANE, [])
    assert held_along_the_wall(known, scene) < 0.01 * held_along_the_wall(unknown, scene)


def test_nor_do_those_of_a_keyframe_that_takes_the_normal_of_its_plane():
    scene, rippled = Planes((WALL,), camera=LARGE), Rippled((WALL,), camera=LARGE)
    T_cw = NEARBY[0]
    depth_m = runtime.to_host(rippled.forward(None, T_cw).depth)
    held = []
    for planes_c in (NO_PLANES, WALL_PLANE @ inverse(T_cw)):
        tracker = exact_tracker(scene)
        tracker.know(NO_PLANES, [Reference(scene.frame(T_cw).colour, depth_m, T_cw, Exposure(), planes_c)])
        held.append(held_along_the_wall(tracker, scene))
    assert held[1] < 0.01 * held[0]


class Farther(Planes):
    """What is rendered lies too far off, by 6 mm."""

    OFF_M = 0.006

    def forward(self, gaussians: GaussianMap | None, T_cw: np.ndarray) -> RenderImages:
        frame = self.frame(T_cw)
        depth_m = frame.depth_m + np.float32(self.OFF_M)
        images = (frame.colour, depth_m, np.ones_like(depth_m), np.zeros_like(frame.colour))
        return RenderImages(*(runtime.to_device(image) for image in images))


def forward_m(config: TrackingConfig, *keyframes: tuple[np.ndarray, float]) -> float:
    """By how much the camera is drawn ahead beside keyframes at those poses, whose depth is too far by so many m."""
    scene = Farther((WALL, SIDE, FLOOR), camera=LARGE)
    references = [
        Reference(frame.colour, frame.depth_m + np.float32(off_m), T_cw, Exposure())
        for frame, T_cw, off_m in ((scene.frame(T_cw), T_cw, off_m) for T_cw, off_m in keyframes)
    ]
    tracker = exact_tracker(scene, changed(config, weight_colour=0.0, weight_gradient=0.0))
    tracker.know(NO_PLANES, references)
    return float((MOTION @ inverse(tracker.track(scene.frame(MOTION), None, np.eye(4), Exposure()).T_cw))[2, 3])


NEARBY = [se3_exp([0.01, -0.02, 0.005, -0.02, 0.01, 0.03]), se3_exp([-0.01, 0.01, 0.0, 0.015, 0.0, -0.02]), MOTION]


def test_keyframes_count_alike_as_many_as_are_used():
    """Of two that are aligned to, an exact one leaves half of the other's pull; more are given than are used."""
    first, second, third = NEARBY
    off = forward_m(CONFIG, (first, Farther.OFF_M))
    assert off == pytest.approx(Farther.OFF_M, rel=0.2)
    both = changed(CONFIG, references=2)
    assert forward_m(both, (first, Farther.OFF_M), (second, 0.0)) == pytest.approx(off / 2, rel=0.05)
    exact = forward_m(both, (first, 0.0), (second, 0.0), (third, Farther.OFF_M))
    assert exact == forward_m(both, (first, 0.0), (second, 0.0))


def test_the_maps_depth_counts_only_where_no_keyframe_shows_the_same():
    alone_m, away = forward_m(CONFIG), se3_exp([0.0, 1.2, 0.0, 0.0, 0.0, 0.0])
    assert alone_m == pytest.approx(Farther.OFF_M, rel=0.2)
    assert forward_m(CONFIG, (NEARBY[0], 0.0)) == pytest.approx(0.0, abs=2e-5)
    assert forward_m(CONFIG, (away, 0.0)) > 0.3 * alone_m


def poses_at(*camera: tuple[float, float]) -> np.ndarray:
    """T_cw [K, 4, 4] of cameras (distance along x in m, angle about y in degrees)."""
    return np.stack([inverse(se3_exp([0, 0, 0, x, 0, 0]) @ se3_exp([0, np.radians(a), 0, 0, 0, 0])) for x, a in camera])


@pytest.mark.parametrize(
    ("cameras", "expected"),
    [
        ([(0, 0)], [0]),
        ([(0, 0), (0.5, 0), (1, 0)], [2, 0]),  # the oldest
        ([(-2, 0), (0, 0), (1, 0)], [2, 1]),  # within 0.8 of the depth
        ([(0, 40), (0, 20), (0, 0)], [2, 1]),  # and 30 degrees
        ([(0, -90), (1, -90), (1.3, -90)], [2, 1]),  # and ahead within 0.2 of the depth
        ([(-2, 0), (0, 90), (0, 0)], [2]),
    ],
)
def test_references_are_the_last_keyframe_and_the_oldest_like_it(cameras, expected):
    assert references_of(poses_at(*cameras), 2.0, 2) == expected


def test_references_are_as_many_as_asked_for():
    poses = poses_at(*((0.01 * k, 0) for k in range(5)))
    assert [references_of(poses, 2.0, count) for count in range(4)] == [[], [4], [4, 0], [4, 0, 1]]


def test_what_is_known_replaces_what_was():
    scene = Farther((WALL, SIDE, FLOOR))
    frame = scene.frame(MOTION)
    tracker = exact_tracker(scene)
    first = tracker.track(frame, None, np.eye(4), Exposure())
    tracker.know(NO_PLANES, [Reference(frame.colour, frame.depth_m, MOTION, Exposure())])
    assert not np.array_equal(tracker.track(frame, None, np.eye(4), Exposure()).T_cw, first.T_cw)
    tracker.know(NO_PLANES, [])
    np.testing.assert_array_equal(tracker.track(frame, None, np.eye(4), Exposure()).T_cw, first.T_cw)


@pytest.mark.parametrize("gain", [0.7, 1.3])
def test_a_keyframe_of_another_exposure_draws_neither_pose_nor_gain(gain):
    """map intensity = gain * frame intensity: the keyframe is darker or brighter than the map, and so is the frame."""
    scene = Planes((WALL, SIDE, FLOOR), contrast=0.2)
    seen, T_cw = scene.frame(np.eye(4)), np.eye(4)
    tracker = exact_tracker(scene)
    tracker.know(NO_PLANES, [Reference(seen.colour / np.float32(gain), seen.depth_m, T_cw, Exposure(gain))])
    result = tracker.track(with_exposure(scene.frame(MOTION), 0.9), None, np.eye(4), Exposure(1.0 / 0.9))
    angle_deg, distance_mm = error(result.T_cw, inverse(MOTION))
    assert angle_deg < 0.05 and distance_mm < 1.0
    assert result.exposure.gain == pytest.approx(1.0 / 0.9, rel=0.01)


@given(gains=st.tuples(*[st.floats(0.5, 2.0)] * 2), biases=st.tuples(*[st.floats(-0.2, 0.2)] * 2), x=st.floats(0, 1))
def test_an_exposure_relative_to_another_leads_to_the_other_image(gains, biases, x):
    one, other = (Exposure(*pair) for pair in zip(gains, biases, strict=True))
    between = one.relative_to(other)
    in_other = between.gain * x + between.bias
    assert other.gain * in_other + other.bias == pytest.approx(one.gain * x + one.bias, abs=1e-9)


def test_three_planes_determine_the_pose_without_any_texture():
    scene = Planes((WALL, SIDE, FLOOR))
    result = exact_tracker(scene).track(scene.frame(MOTION), None, np.eye(4), Exposure())
    angle_deg, distance_mm = error(result.T_cw, inverse(MOTION))
    assert not result.lost and angle_deg < 0.05 and distance_mm < 1.0
    values = np.linalg.eigvalsh(result.information)
    assert values[0] > 1e-4 * values[-1] and result.measures["condition"] < 1e4
    np.testing.assert_allclose(result.information, result.information.T, rtol=1e-9)


def test_one_blank_plane_leaves_three_directions_and_the_frame_is_lost():
    """Sliding along the plane, two ways, and turning about its normal."""
    scene = Planes((WALL,))
    result = exact_tracker(scene).track(scene.frame(MOTION), None, np.eye(4), Exposure())
    assert result.lost and "not determined" in result.message and "condition" in result.message
    values, directions = np.linalg.eigh(result.information)
    assert (abs(values[:3]) < 1e-6 * values[3]).all()
    normal = result.T_cw[:3, :3] @ np.array(WALL[0]) / np.linalg.norm(WALL[0])
    blind = np.zeros((6, 3))
    blind[3:, :2] = np.linalg.svd(normal[None])[2][1:].T
    blind[:3, 2] = normal
    outside = blind - directions[:, :3] @ (directions[:, :3].T @ blind)
    assert abs(outside).max() < 1e-3


def test_two_blank_planes_leave_the_direction_of_their_intersection():
    scene = Planes((WALL, FLOOR))
    result = exact_tracker(scene).track(scene.frame(MOTION), None, np.eye(4), Exposure())
    values, directions = np.linalg.eigh(result.information)
    assert abs(values[0]) < 5e-3 * values[1]
    line = np.cross(*(result.T_cw[:3, :3] @ np.array(plane[0]) for plane in (WALL, FLOOR)))
    assert abs(directions[3:, 0] @ line) / np.linalg.norm(line) > 0.999


def test_texture_determines_what_one_plane_leaves_open():
    scene = Planes((WALL,), contrast=0.4)
    result = exact_tracker(scene).track(scene.frame(MOTION), None, np.eye(4), Exposure())
    angle_deg, distance_mm = error(result.T_cw, inverse(MOTION))
    assert not result.lost and angle_deg < 0.05 and distance_mm < 2.0


@dataclass
class Explored(Planes):
    """Only what is left of a column is in the map, and fades into black over some pixels, as splats do."""

    def forward(self, gaussians: GaussianMap | None, T_cw: np.ndarray) -> RenderImages:
        frame = self.frame(T_cw)
        opacity = np.float32(ndtr((44.0 - np.arange(self.camera.width)) / 2.0)) * np.ones_like(frame.depth_m)
        colour = frame.colour * opacity[..., None]
        images = (colour, frame.depth_m * opacity, opacity, np.zeros_like(frame.colour))
        return RenderImages(*(runtime.to_device(image) for image in images))


def test_the_rim_of_the_map_does_not_draw_the_pose():
    scene = Explored((WALL,), contrast=0.2)
    off_mm = []
    for rim_opacity in (0.0, ModelSettings().rim_opacity):
        one = exact_tracker(scene, changed(CONFIG, rim_opacity=rim_opacity))
        off_mm.append(error(one.track(scene.frame(MOTION), None, np.eye(4), Exposure()).T_cw, inverse(MOTION))[1])
    assert off_mm[1] < 10.0 < 0.1 * off_mm[0]


def live_images(level: LiveLevel) -> dict[str, np.ndarray]:
    """What the kernel is given of a frame, as the twin takes it."""
    pixels = runtime.to_host(level.pixels).swapaxes(2, 3).astype(float)
    pixels = pixels.reshape(level.camera.height, -1, alignment.LIVE)[:, : level.camera.width]
    images = dict(zip(("depth", "grey", "gx", "gy"), np.moveaxis(pixels, -1, 0), strict=False))
    strength = pixels[..., alignment.LIVE_STRENGTH]
    gate = 1 - np.clip((strength - level.gate_low) * level.gate_inverse_range, 0, 1)
    return images | {"gate": gate, "saturated": strength < 0}


def model_images(level: ModelLevel) -> dict[str, np.ndarray]:
    """What the kernel is given of the model, as the twin takes it."""
    surface, texture = (runtime.to_host(array).astype(float) for array in (level.surface, level.texture))
    images = dict(zip(("grey", "gx", "gy", "gxx", "gxy", "gyy"), np.moveaxis(texture, -1, 0), strict=False))
    return images | {"normal": surface[..., :3], "depth": surface[..., alignment.MODEL_DEPTH]}


def test_the_information_is_how_the_cost_grows_with_the_pose():
    """By a left perturbation of T_cw, far from the model's pose, so that the adjoint between them matters."""
    scene = Planes((WALL, SIDE, FLOOR), contrast=0.3)
    T_mw = se3_exp([0.03, -0.06, 0.05, 0.12, -0.08, 0.1])
    frame = scene.frame(MOTION)
    config = changed(CONFIG, surface_sigma_m=0.0)  # the more depth weighs, the less creases and borders matter
    result = exact_tracker(scene, config).track(frame, None, T_mw, Exposure())
    loss = LossConfig()
    live = live_images(LivePyramid(TINY, 0, 1, loss).update(frame)[0])
    model = model_images(ModelPyramid(TINY, 0, 1, loss.noise, ModelSettings()).update(scene.forward(None, T_mw))[0])
    settings = reference.Settings(
        TINY.fx, TINY.fy, TINY.cx, TINY.cy, result.exposure.gain, result.exposure.bias,
        loss.noise.per_m2, RESIDUALS.max_distance_sigmas,
        loss.expert.penalties.charbonnier_depth_sigmas, loss.expert.texture.gate_depth_boost,
        RESIDUALS.sigma_colour, RESIDUALS.sigma_gradient,
        RESIDUALS.weight_depth, RESIDUALS.weight_colour, RESIDUALS.weight_gradient,
        config.expert.residuals.surface_sigma_m, 0.0,
    )  # fmt: skip
    assert len(fields(settings)) == 17

    def cost(xi: np.ndarray) -> float:
        return reference.cost(settings, T_mw @ inverse(se3_exp(xi) @ result.T_cw), live, model)

    information = RESIDUALS.correlated_px * result.information  # as if every pixel spoke for itself
    for way in np.eye(6)[[0, 2, 4, 5]]:
        step = way / np.sqrt(way @ information @ way) * 12.0  # a small part of a sigma for each pixel
        growth = cost(step) + cost(-step) - 2 * cost(np.zeros(6))
        assert growth == pytest.approx(step @ information @ step, rel=0.1)  # creases and borders: not quadratic
    # The cost is too rough to tell one frame from another; the twin's matrix, carried over by differences, is not
    T_ml = T_mw @ inverse(result.T_cw)
    moves = [
        (model_motion(T_mw, result.T_cw, T_ml, xi) - model_motion(T_mw, result.T_cw, T_ml, -xi)) / 2e-6
        for xi in 1e-6 * np.eye(6)
    ]
    carry = np.array(moves).T
    expected = carry.T @ reference.normal_equations(settings, T_ml, live, model)["A"] @ carry
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(information / np.outer(scale, scale), expected / np.outer(scale, scale), atol=3e-3)


def model_motion(T_mw: np.ndarray, T_cw: np.ndarray, T_ml: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """The left perturbation of T_ml that a left perturbation xi of T_cw amounts to."""
    return se3_log(T_mw @ inverse(se3_exp(xi) @ T_cw) @ inverse(T_ml))


def test_assessing_a_pose_agrees_with_having_tracked_it():
    scene = Planes((WALL, SIDE, FLOOR), contrast=0.3)
    one = exact_tracker(scene)
    tracked = one.track(scene.frame(MOTION), None, np.eye(4), Exposure())
    assessed = one.assess(scene.frame(MOTION), None, tracked.T_cw, tracked.exposure)
    np.testing.assert_array_equal(assessed.T_cw, tracked.T_cw)
    scale = np.sqrt(np.diag(tracked.information))
    ratio = (assessed.information - tracked.information) / np.outer(scale, scale)
    assert abs(ratio).max() < 0.1
    assert not assessed.lost and assessed.measures["inlier_ratio"] > 0.8  # creases have no normals


# --- lost ---

GOOD = {"overlap": 0.9, "agreement": 0.98, "inlier_ratio": 0.9, "colour_residual": 0.01, "condition": 100.0}


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"overlap": 0.05}, "5% of the frame meets the map"),
        ({"agreement": 0.3}, "30% of what meets the map"),
        ({"inlier_ratio": 0.2}, "20% of the matched pixels"),
        ({"condition": 1e9}, "not determined"),
        ({"condition": float("inf")}, "not determined"),
        ({"condition": float("nan")}, "not determined"),
    ],
)
def test_evidence_names_what_is_wrong(change, word):
    assert LostDetector(LostSettings()).judge(GOOD) == ""
    assert word in LostDetector(LostSettings()).judge(GOOD | change)


def test_colours_far_worse_than_they_were_are_suspect():
    detector = LostDetector(LostSettings())
    assert detector.judge(GOOD | {"colour_residual": 0.2}) == ""  # nothing is known yet of what is usual
    detector = LostDetector(LostSettings())
    for _ in range(5):
        detector.accept(GOOD | {"colour_residual": 0.02})
    assert detector.judge(GOOD | {"colour_residual": 0.02}) == ""
    assert detector.judge(GOOD | {"colour_residual": 0.055}) == ""  # less than three times the usual
    assert "colours are off by 0.10" in detector.judge(GOOD | {"colour_residual": 0.1})
    assert "colours" in detector.judge(GOOD | {"colour_residual": 0.1})  # what is judged is not usual yet


def test_a_small_colour_residual_is_never_suspect():
    detector = LostDetector(LostSettings())
    for _ in range(5):
        detector.accept(GOOD | {"colour_residual": 0.001})
    assert detector.judge(GOOD | {"colour_residual": 0.035}) == ""


def test_thresholds_are_the_configs():
    lenient = LostSettings(min_map_overlap=0.01, min_inlier_ratio=0.0, max_condition=1e12)
    assert LostDetector(lenient).judge(GOOD | {"overlap": 0.02, "inlier_ratio": 0.01, "condition": 1e10}) == ""
    strict = LostSettings(min_map_overlap=0.95)
    assert "meets the map" in LostDetector(strict).judge(GOOD)


def unrelated(kind: str, frame: Frame) -> Frame:
    rng, shape = np.random.default_rng(0), frame.depth_m.shape
    depth_m = {
        "twice as far": lambda: 2.0 * frame.depth_m,
        "half as far": lambda: 0.5 * frame.depth_m,
        "a hand on the lens": lambda: np.full(shape, 0.3),
        "noise": lambda: rng.uniform(0.5, 5.0, shape),
        "no depth": lambda: np.zeros(shape),
    }[kind]()
    colour = rng.random(frame.colour.shape) if kind == "noise" else frame.colour
    return replace(frame, colour=colour.astype(np.float32), depth_m=depth_m.astype(np.float32))


KINDS = ["twice as far", "half as far", "a hand on the lens", "noise", "no depth"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scene", ["room", "blank"])
@pytest.mark.parametrize("solver", ["gauss_newton", "first_order"])
def test_an_unrelated_frame_is_lost_and_the_message_says_why(kind, scene, solver):
    one, gaussians = source(scene, True), map_of(scene, 30, True)
    config = changed(CONFIG, solver=solver, adam_steps=(4, 4))
    result = tracker(config).track(unrelated(kind, one.read(31)), gaussians, inverse(one.pose(30)), Exposure())
    assert result.lost
    assert "meets the map" in result.message or "three sigma" in result.message
    assert np.isfinite(result.T_cw).all() and np.isfinite(result.exposure.gain)


@pytest.mark.parametrize("solver", ["gauss_newton", "first_order"])
def test_an_empty_map_loses_every_frame(solver):
    one = source("room")
    config = changed(CONFIG, solver=solver, adam_steps=(2, 2))
    result = tracker(config).track(one.read(0), GaussianMap(), np.eye(4), Exposure())
    assert result.lost and "meets the map" in result.message
    assert result.measures["overlap"] == 0.0
    np.testing.assert_allclose(result.T_cw, np.eye(4), atol=1e-6)


# --- prediction ---

VELOCITY = np.array([0.3, -0.2, 0.1, 0.5, 0.1, -0.4])  # rad/s, m/s
START = se3_exp([0.2, 0.1, -0.3, 1.0, 2.0, 3.0])


def moved(seconds: float) -> np.ndarray:
    return se3_exp(VELOCITY * seconds) @ START


EXACT = 1e14 * np.eye(6)  # the information of poses without noise


def test_without_a_past_nothing_moves():
    motion = MotionFilter(HANDS)
    np.testing.assert_array_equal(motion.predict(5.0), np.eye(4))
    motion.update(5.0, START, EXACT)
    np.testing.assert_allclose(motion.predict(9.0), START, atol=1e-12)


@pytest.mark.parametrize("times_s", [(0.0, 0.1, 0.2), (0.0, 0.03, 0.5), (7.0, 7.9, 7.95)])
def test_a_steady_motion_is_foretold_at_any_time(times_s):
    motion = MotionFilter(HANDS)
    for time_s in times_s[:2]:
        motion.update(time_s, moved(time_s), EXACT)
    np.testing.assert_allclose(motion.predict(times_s[2]), moved(times_s[2]), atol=1e-9)
    np.testing.assert_allclose(motion.predict(times_s[1]), moved(times_s[1]), atol=1e-12)


def test_equal_or_earlier_timestamps_keep_the_velocity():
    motion = MotionFilter(HANDS)
    motion.update(0.0, moved(0.0), EXACT)
    motion.update(0.1, moved(0.1), EXACT)
    for time_s in (0.1, 0.05):
        motion.update(time_s, START, EXACT)
        np.testing.assert_allclose(motion.predict(time_s + 0.2), moved(0.2), atol=1e-9)


def test_the_prediction_is_trusted_but_for_what_hands_do_and_less_without_a_velocity():
    motion = MotionFilter(HANDS)
    assert not motion.information(3.0).any()
    motion.update(3.0, START, EXACT)
    unknown = motion.information(3.1)
    motion.update(3.1, moved(0.1), EXACT)
    for elapsed_s in (0.03, 0.1, 1.0):
        sigmas = np.diag(motion.information(3.1 + elapsed_s)) ** -0.5
        np.testing.assert_allclose(sigmas[:3], HANDS.acceleration_rad * elapsed_s**2, rtol=1e-3)
        np.testing.assert_allclose(sigmas[3:], HANDS.acceleration_m * elapsed_s**2, rtol=1e-3)
    assert (np.diag(unknown) < 0.9 * np.diag(motion.information(3.2))).all()
    assert np.isfinite(motion.information(3.1)).all() and np.isfinite(motion.information(2.0)).all()
    motion.coast(3.2, moved(0.2))
    assert not motion.information(3.3).any()  # lost: wherever it is found
    motion.update(3.3, moved(0.7), EXACT)
    np.testing.assert_allclose(motion.predict(3.4), moved(0.7), atol=1e-12)  # how it came there says nothing
    np.testing.assert_allclose(motion.information(3.4), unknown, rtol=1e-6)


def test_velocity_is_what_all_poses_say_of_it_by_their_uncertainties():
    """Poses along an axis and what the filter makes of them, against least squares over all of them at once."""
    count, dt, rng = 25, 1.0 / 30.0, np.random.default_rng(3)
    measured_m = np.concatenate([[0.0], 0.4 * dt * np.arange(1, count) + rng.normal(0.0, 0.006, count - 1)])
    weights = rng.uniform(0.5, 2.0, count) * 0.006**-2
    weights[15:] = 1.0  # all but unseen from here on
    motion, T_cw = MotionFilter(HANDS), np.eye(4)
    motion.update(0.0, T_cw.copy(), EXACT)
    for k in range(1, count):  # as a tracker fuses what it sees with the prediction
        predicted_m, trust = motion.predict(k * dt)[0, 3], motion.information(k * dt)[3, 3]
        T_cw[0, 3] = (trust * predicted_m + weights[k] * measured_m[k]) / (trust + weights[k])
        motion.update(k * dt, T_cw.copy(), np.diag([1e6, 1e6, 1e6, weights[k], 1e6, 1e6]))
    # unknown: the velocity before each frame but the first, where it is 0 +- speed_m; x_k is what they have added up to
    rows, sides = [np.eye(count - 1)[0] / HANDS.speed_m], [0.0]
    jump = HANDS.acceleration_m * dt
    rows[0] /= np.hypot(1.0, jump / HANDS.speed_m)  # it may have changed before the first step, too
    for k in range(1, count - 1):
        rows.append((np.eye(count - 1)[k] - np.eye(count - 1)[k - 1]) / jump)
        sides.append(0.0)
    for k in range(1, count):
        rows.append(dt * (np.arange(count - 1) < k) * np.sqrt(weights[k]))
        sides.append(measured_m[k] * np.sqrt(weights[k]))
    A, b = np.array(rows), np.array(sides)
    velocities = np.linalg.lstsq(A, b, rcond=None)[0]
    covariance = np.linalg.inv(A.T @ A)
    steps = dt * np.ones(count - 1)
    steps[-1] += dt  # the next frame's, with the last velocity
    spread = steps @ covariance @ steps + (jump * dt) ** 2
    assert motion.predict(count * dt)[0, 3] == pytest.approx(steps @ velocities, abs=1e-9)
    assert motion.information(count * dt)[3, 3] == pytest.approx(1.0 / spread, rel=1e-6)


def test_a_world_that_moves_takes_the_prediction_with_it_and_not_the_velocity():
    motion, correction = MotionFilter(HANDS), se3_exp([0.1, 0.2, -0.1, 0.3, 0.0, 0.4])
    motion.move(correction)
    motion.update(0.0, moved(0.0), EXACT)
    motion.update(0.1, moved(0.1), EXACT)
    motion.move(correction)
    np.testing.assert_allclose(motion.predict(0.2), moved(0.2) @ inverse(correction), atol=1e-9)


@pytest.mark.parametrize("sigma", [1e-6, 10.0])
def test_a_firm_prior_counts_beside_pixels_by_its_deviations(sigma):
    scene, start = Planes((WALL, SIDE, FLOOR)), se3_exp([0.0, 0.0, 0.0, 0.01, -0.005, 0.01])
    found = exact_tracker(scene).track(scene.frame(np.eye(4)), None, start, Exposure(), np.eye(6) / sigma**2, firm=True)
    np.testing.assert_allclose(found.T_cw, start if sigma < 1.0 else np.eye(4), atol=1e-6 if sigma < 1.0 else 2e-3)


def test_at_a_pose_that_is_known_the_exposure_is_fitted_where_it_is_asked_for():
    scene = Planes((WALL, SIDE, FLOOR))
    dim, tracker = with_exposure(scene.frame(np.eye(4)), 0.8), exact_tracker(scene, changed(CONFIG, exposure="gain"))
    fitted = tracker.assess(dim, None, np.eye(4), Exposure(), fits_exposure=True)
    assert fitted.exposure.gain == pytest.approx(1.25, rel=0.01)
    np.testing.assert_array_equal(fitted.T_cw, np.eye(4))
    assert tracker.assess(dim, None, np.eye(4), Exposure()).exposure == Exposure()


def test_a_prior_holds_the_directions_in_which_pixels_say_little_and_no_others():
    """Before a blank wall: it tells distance and tilt, and nothing of the rest."""
    scene = Planes((WALL,), contrast=0.0)
    start, prior = se3_exp([0.0, 0.0, 0.0, 0.03, -0.02, 0.04]), np.diag(np.array([0.02] * 3 + [0.03] * 3) ** -2.0)
    found = exact_tracker(scene).track(scene.frame(np.eye(4)), None, start, Exposure(), prior)
    normal = np.array(WALL[0]) / np.linalg.norm(WALL[0])
    shift = found.T_cw[:3, 3] - start[:3, 3]
    assert abs(found.T_cw[:3, 3] @ normal) < 0.002  # the distance is the wall's
    assert np.linalg.norm(shift - (shift @ normal) * normal) < 0.002  # along it the camera is where it was foretold


def test_coasting_halves_the_motion_each_time():
    motion = MotionFilter(HANDS)
    motion.update(0.0, moved(0.0), EXACT)
    motion.update(1.0, moved(1.0), EXACT)
    motion.coast(1.0, moved(1.0))
    np.testing.assert_allclose(motion.predict(2.0), moved(1.5), atol=1e-9)
    motion.coast(1.0, moved(1.0))
    np.testing.assert_allclose(motion.predict(2.0), moved(1.25), atol=1e-9)


def test_a_camera_that_accelerates_more_than_hands_do_is_believed_to():
    """On a drone, or with times that are invented: one frame is a surprise, from then on more is allowed."""
    motion, allowed = MotionFilter(HANDS), []
    jerks = np.random.default_rng(0).normal(0.0, 40.0 * HANDS.acceleration_m * 0.01**2, (60, 3))
    places = np.cumsum(np.cumsum(jerks, axis=0), axis=0)
    for k, place in enumerate(places):
        motion.update(0.01 * k, se3_exp([0, 0, 0, *place]), EXACT)
        allowed.append(np.diag(motion.information(0.01 * (k + 1))) ** -0.5)
    learnt_m = np.array(allowed)[20:, 3]
    assert 0.3 * 40.0 < np.median(learnt_m) / (HANDS.acceleration_m * 0.01**2) < 3.0 * 40.0
    np.testing.assert_allclose(np.array(allowed)[20:, 0], HANDS.acceleration_rad * 0.01**2, rtol=1e-3)  # it never turns
    for k in range(60, 160):  # it comes to rest, and is forgiven
        motion.update(0.01 * k, se3_exp([0, 0, 0, *places[-1]]), EXACT)
    rested_m = np.diag(motion.information(1.6)) ** -0.5
    np.testing.assert_allclose(rested_m[3], HANDS.acceleration_m * 0.01**2, rtol=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_a_prior_speaks_where_pixels_do_not(seed):
    rng = np.random.default_rng(seed)
    basis = rng.normal(size=(6, 6))
    prior = basis @ basis.T
    strength = np.array([1e4, 1e3, 100.0, 1.0, 1e-3, 0.0])
    information = (basis * strength) @ basis.T
    expected = (basis / (1.0 + strength) ** 2) @ basis.T
    np.testing.assert_allclose(unopposed(prior, information), expected, atol=1e-6)
    np.testing.assert_allclose(unopposed(prior, np.zeros((6, 6))), prior, atol=1e-9)
    assert not unopposed(np.zeros((6, 6)), information).any()


def test_a_wrong_prediction_does_not_draw_what_pixels_hold():
    scene = Planes((WALL, SIDE, FLOOR), contrast=0.3)
    loose = 1e4 * np.eye(6)  # by 1 cm and 10 mrad, where pixels hold the camera to 2 mm and 1 mrad
    found = exact_tracker(scene).track(scene.frame(MOTION), None, np.eye(4), Exposure(), loose)
    free = exact_tracker(scene).track(scene.frame(MOTION), None, np.eye(4), Exposure())
    error_m = np.linalg.norm((found.T_cw @ inverse(free.T_cw))[:3, 3])
    assert error_m < 0.25 * np.linalg.norm(free.T_cw[:3, 3])
