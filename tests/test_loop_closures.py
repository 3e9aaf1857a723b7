"""Visual loop closure: features, retrieval, verification, and the search over rendered walks with known truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.tiers import changed
from tgslam.camera import Camera, SensorNoise
from tgslam.config.graph_settings import LoopConfig, SolvingSettings
from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.built_in import SyntheticSource, synthetic_camera
from tgslam.geometry import inverse, se3_exp, se3_log
from tgslam.graph.findings import Findings
from tgslam.graph.pose_graph import PoseGraph
from tgslam.graph.visual.depth_agreement import DepthGrid, agreement
from tgslam.graph.visual.features import Detector, Features, matches
from tgslam.graph.visual.loop_search import LoopSearch
from tgslam.graph.visual.retrieval import Retrieval
from tgslam.graph.visual.verification import Look, Sameness, Verification
from tgslam.synthetic.sensor import DEPTH_SIGMA_PER_M2
from tgslam.types import Frame, RelativePose

CONFIG = LoopConfig()
MATCHING = CONFIG.expert.matching
NOISE = SensorNoise(DEPTH_SIGMA_PER_M2)
CAMERA = synthetic_camera(320, 240)
MAX_M, MAX_RAD = 0.02, np.deg2rad(0.5)
STEP_SIGMA = np.array([1e-3] * 3 + [3e-3] * 3)  # rad, m: what the graph believes of a step between keyframes


@dataclass(frozen=True)
class Walk:
    """Keyframes of a built-in scene, with noise, and their true poses."""

    frames: list[Frame]
    T_cw: dict[int, np.ndarray]

    def motion(self, i: int, j: int) -> np.ndarray:
        return self.T_cw[j] @ inverse(self.T_cw[i])


@cache
def walk(scene: str, count: int, step: int) -> Walk:
    source = SyntheticSource(SyntheticConfig(scene=scene, frames=count * step, width=320, height=240), 0)
    chosen = range(0, count * step, step)
    return Walk([source.read(k) for k in chosen], {n: inverse(source.pose(k)) for n, k in enumerate(chosen)})


def believed(T_cw: dict[int, np.ndarray], scale: float = 1.0) -> Callable[[int, int], tuple[np.ndarray, np.ndarray]]:
    """What a graph of odometry alone would say: motions with the covariance of a random walk."""
    return lambda i, j: (T_cw[j] @ inverse(T_cw[i]), np.diag((scale * STEP_SIGMA) ** 2) * abs(j - i))


def drifting(truth: Walk, error: np.ndarray) -> dict[int, np.ndarray]:
    """Poses with the same error at each step."""
    T_cw = {0: truth.T_cw[0]}
    for k in range(1, len(truth.frames)):
        T_cw[k] = se3_exp(error) @ truth.motion(k - 1, k) @ T_cw[k - 1]
    return T_cw


def searched(truth: Walk, T_cw: dict[int, np.ndarray], config: LoopConfig = CONFIG) -> list[Findings]:
    """Of each keyframe in turn."""
    search = LoopSearch(CAMERA, NOISE, config)
    known: dict[int, np.ndarray] = {}
    found = []
    for k, frame in enumerate(truth.frames):
        known[k] = T_cw[k]
        found.append(search.find(k, frame.colour, frame.depth_m, known, believed(known)))
    return found


def errors(truth: Walk, found: list[Findings]) -> np.ndarray:
    """[N, 3] rad, m and squared Mahalanobis distance of each closure from the truth."""
    rows = []
    for k, findings in enumerate(found):
        for closure in findings.closures:
            assert closure.earlier <= k - CONFIG.loop_gap and closure.shared == () and closure.measured.rank == 6
            error = se3_log(closure.measured.T_ji @ inverse(truth.motion(closure.earlier, k)))
            squares = error @ closure.measured.motion.information @ error
            rows.append((np.linalg.norm(error[:3]), np.linalg.norm(error[3:]), squares))
    return np.array(rows).reshape(-1, 3)


def features(frame: Frame) -> Features:
    return Detector(CONFIG.features, MATCHING.corner_contrast).detect(frame.colour, frame.depth_m)


def look(frame: Frame) -> Look:
    return Look(features(frame), DepthGrid.of(frame.depth_m, CAMERA))


class TestFeatures:
    def test_points_are_on_the_surfaces(self) -> None:
        truth = walk("room", 2, 8)
        found = features(truth.frames[0])
        assert 200 < len(found) <= CONFIG.features
        assert found.descriptors.dtype == np.uint8 and found.descriptors.shape == (len(found), 32)
        assert (found.depth_m > 0).all()
        points = found.points(CAMERA)
        assert_allclose(points[:, 2], found.depth_m)
        pixels = points[:, :2] / points[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
        assert_allclose(pixels, found.pixels, atol=1e-3)

    def test_none_beside_holes_or_across_depth_edges(self) -> None:
        frame = walk("room", 2, 8).frames[0]
        depth = np.full_like(frame.depth_m, 2.0)
        assert len(Detector(CONFIG.features, MATCHING.corner_contrast).detect(frame.colour, depth)) > 300
        depth[:, 160:] = 3.0
        depth[120:] = 0.0
        u, v = np.rint(Detector(CONFIG.features, MATCHING.corner_contrast).detect(frame.colour, depth).pixels).T
        assert len(u) > 20 and (v < 119).all() and (abs(u - 159.5) > 1).all()

    def test_matches_are_of_the_same_points(self) -> None:
        truth = walk("room", 2, 8)
        a, b = (features(frame) for frame in truth.frames)
        i, j = matches(a, b, MATCHING).T
        assert len(i) > 60 and len(set(i)) == len(set(j)) == len(i)
        moved = a.points(CAMERA)[i] @ truth.motion(0, 1)[:3, :3].T + truth.motion(0, 1)[:3, 3]
        assert np.median(np.linalg.norm(moved - b.points(CAMERA)[j], axis=1)) < 0.02

    def test_what_is_ambiguous_does_not_match(self) -> None:
        rng = np.random.default_rng(0)
        descriptors = rng.integers(0, 256, (20, 32), np.uint8)
        a = Features(rng.uniform(0, 300, (20, 2)).astype("f4"), np.ones(20, "f4"), np.ones(20, "f4"), descriptors)
        assert_array_equal(matches(a, a, MATCHING), np.column_stack([np.arange(20)] * 2))

        def twice(shift_px: float) -> Features:
            pixels = np.concatenate([a.pixels, a.pixels + np.float32(shift_px)])
            return Features(pixels, np.ones(40, "f4"), np.ones(40, "f4"), np.concatenate([descriptors] * 2))

        assert len(matches(a, twice(100.0), MATCHING)) == 0
        assert len(matches(a, twice(1.0), MATCHING)) == 20  # one corner found twice

    def test_spread_over_the_image(self) -> None:
        """One busy corner takes no more than its share."""
        rng = np.random.default_rng(0)
        picture = np.full((240, 320), 0.5, np.float32)
        picture[40:200:20, 40:280:20] = 0.7
        picture[40:80, 40:80] = np.kron(rng.uniform(0, 1, (10, 10)), np.ones((4, 4)))
        found = Detector(100, MATCHING.corner_contrast).detect(
            np.repeat(picture[..., None], 3, 2), np.ones_like(picture)
        )
        assert len(found) == 100 and (found.pixels > 85).any(axis=1).mean() > 0.5

    @pytest.mark.parametrize("shape", [(240, 320), (20, 24)])
    def test_no_texture_gives_none(self, shape: tuple[int, int]) -> None:
        empty = Detector(CONFIG.features, MATCHING.corner_contrast).detect(
            np.full((*shape, 3), 0.5, np.float32), np.ones(shape, np.float32)
        )
        assert len(empty) == 0 and empty.points(CAMERA).shape == (0, 3)
        some = features(walk("room", 2, 8).frames[0])
        assert len(matches(empty, some, MATCHING)) == len(matches(some, empty, MATCHING)) == 0


class TestRetrieval:
    def test_a_noisy_copy_is_the_most_alike(self) -> None:
        rng = np.random.default_rng(0)
        images = rng.integers(0, 256, (100, 300, 32), np.uint8)
        retrieval = Retrieval()
        for image in images:
            retrieval.add(retrieval.words(image))
        flips = np.packbits(rng.random((300, 256)) < 0.12, axis=1)
        scores = retrieval.scores(retrieval.words(rng.permutation(images[41] ^ flips)))
        assert len(retrieval) == len(scores) == 100
        assert scores.argmax() == 41 and scores[41] > 5 * np.sort(scores)[-2]

    def test_what_all_images_hold_says_nothing(self) -> None:
        rng = np.random.default_rng(0)
        common, own = rng.integers(0, 256, (200, 32), np.uint8), rng.integers(0, 256, (50, 20, 32), np.uint8)
        retrieval = Retrieval()
        for image in own:
            retrieval.add(retrieval.words(np.concatenate([common, image])))
        scores = retrieval.scores(retrieval.words(np.concatenate([common, own[7]])))
        assert scores.argmax() == 7 and scores[7] > 3 * np.sort(scores)[-2]

    def test_empty(self) -> None:
        retrieval = Retrieval()
        nothing = retrieval.words(np.zeros((0, 32), np.uint8))
        assert len(nothing) == 0 and retrieval.scores(nothing).shape == (0,)
        retrieval.add(nothing)
        assert_array_equal(retrieval.scores(retrieval.words(np.zeros((3, 32), np.uint8))), [0.0])
        assert_array_equal(retrieval.scores(nothing), [0.0])


class TestDepthAgreement:
    def test_right_and_wrong_motions(self) -> None:
        truth = walk("room", 2, 8)
        a, b = (DepthGrid.of(frame.depth_m, CAMERA) for frame in truth.frames)
        agreeing, overlap = agreement(a, b, truth.motion(0, 1), NOISE)
        assert agreeing > 0.97 and overlap > 0.6
        moved = se3_exp([0.0, 0.0, 0.0, 0.0, 0.0, -0.6]) @ truth.motion(0, 1)
        assert agreement(a, b, moved, NOISE)[0] < 0.5
        turned = se3_exp([0.0, 2.5, 0.0, 0.0, 0.0, 0.0]) @ truth.motion(0, 1)
        assert agreement(a, b, turned, NOISE)[1] < 0.05

    def test_what_is_hidden_speaks_neither_for_nor_against(self) -> None:
        wall, hand = np.full((240, 320), 3.0, np.float32), np.full((240, 320), 3.0, np.float32)
        hand[:, :160] = 1.0
        a, b = DepthGrid.of(wall, CAMERA), DepthGrid.of(hand, CAMERA)
        assert_allclose(agreement(a, b, np.eye(4), NOISE), (2 / 3, 0.5), atol=1e-6)

    def test_no_depth(self) -> None:
        nothing = DepthGrid.of(np.zeros((240, 320), np.float32), CAMERA)
        assert agreement(nothing, nothing, np.eye(4), NOISE) == (0.0, 0.0)

    def test_grid_points_are_where_the_pixels_are(self) -> None:
        camera = Camera(101, 75, 90.0, 91.0, 50.2, 37.7)
        grid = DepthGrid.of(np.full((75, 101), 2.0, np.float32), camera)
        assert grid.depth_m.shape == (grid.camera.height, grid.camera.width) == (37, 50)
        first = [(1 - 50.2) / 90.0 * 2, (1 - 37.7) / 91.0 * 2, 2.0]
        assert_allclose(grid.points()[0], first)


class TestVerification:
    def compared(self, scene: str, count: int, step: int, config: LoopConfig = CONFIG) -> list[Sameness | None]:
        """Keyframe 0 with each of the others."""
        looks = [look(frame) for frame in walk(scene, count, step).frames]
        verification = Verification(CAMERA, NOISE, config)
        return [verification.compare(looks[0], other) for other in looks[1:]]

    def test_views_of_one_place(self) -> None:
        truth = walk("room", 4, 8)
        for k, same in enumerate(self.compared("room", 4, 8), 1):
            assert same is not None and same.inliers >= CONFIG.expert.place.min_inliers and same.measured.rank == 6
            error = se3_log(same.measured.T_ji @ inverse(truth.motion(0, k)))
            assert np.linalg.norm(error[:3]) < MAX_RAD and np.linalg.norm(error[3:]) < MAX_M

    def test_surfaces_hold_what_few_features_leave(self) -> None:
        """Wide apart, and with some of the features only."""
        truth = walk("room", 4, 8)
        first, last = look(truth.frames[0]), look(truth.frames[3])
        verification = Verification(CAMERA, NOISE, changed(CONFIG, min_seen_again=0.0))
        same = verification.compare(first, last)
        assert same is not None

        def error(T_ji: np.ndarray) -> np.ndarray:
            return se3_log(T_ji @ inverse(truth.motion(0, 3)))

        astray = se3_exp([0.01, -0.01, 0.01, 0.02, -0.02, 0.02]) @ same.measured.T_ji
        few = replace(same, measured=replace(same.measured, T_ji=astray), points=same.points[np.arange(8)])
        for start in (same, few):
            refined = verification.refined(start, first, last)
            assert refined.rank == 6
            assert np.linalg.norm(error(refined.T_ji)[:3]) < 0.005 and np.linalg.norm(error(refined.T_ji)[3:]) < 0.01

    def test_views_of_two_places(self) -> None:
        assert self.compared("desk", 4, 150) == [None] * 3

    def test_a_picture_moved_to_another_room_is_no_place(self) -> None:
        """Features agree on a motion, but the depth around them does not."""
        frame = walk("room", 4, 8).frames[0]
        there = replace(frame, depth_m=frame.depth_m.copy())
        there.depth_m[:, :110] = there.depth_m[:, 230:] = 1.0
        there.depth_m[:90] = 0.8
        verification = Verification(CAMERA, NOISE, changed(CONFIG, min_inlier_share=0.0))
        assert verification.compare(look(frame), look(frame)) is not None
        assert verification.compare(look(frame), look(there)) is None

    def test_one_thing_seen_twice_is_no_place(self) -> None:
        """Such as a door: depth agrees, and its features do, but those round it are missing."""
        rng = np.random.default_rng(0)
        pattern, other = (np.kron(rng.uniform(0.2, 0.8, (60, 80)), np.ones((4, 4))).astype("f4") for _ in range(2))
        other[80:165, 90:205] = pattern[80:165, 90:205]
        wall = np.full((240, 320), 2.0, np.float32)
        here, there = (look(Frame(0, 0.0, np.repeat(p[..., None], 3, 2), wall)) for p in (pattern, other))
        few = changed(CONFIG, min_inliers=10, known_rad=0.1, known_m=0.2)
        same = Verification(CAMERA, NOISE, changed(few, min_seen_again=0.0)).compare(here, there)
        assert same is not None
        assert_allclose(same.measured.T_ji, np.eye(4), atol=0.01)
        verification = Verification(CAMERA, NOISE, few)
        assert verification.compare(here, there) is None
        assert verification.compare(here, here) is not None

    def test_another_exposure(self) -> None:
        first, second = walk("room", 2, 8).frames
        darker = replace(second, colour=second.colour * np.float32(0.7))
        same = Verification(CAMERA, NOISE, CONFIG).compare(look(first), look(darker))
        assert same is not None and same.inliers > 40

    def test_no_more_is_known_than_all_features_have_in_error_together(self) -> None:
        for same in self.compared("room", 2, 8):
            assert same is not None
            common = CONFIG.expert.measuring
            sigma2 = np.diag(np.linalg.inv(same.measured.motion.information))
            assert (sigma2 > np.array([common.common_sigma_rad**2] * 3 + [common.common_sigma_m**2] * 3)).all()


class TestSearch:
    DRIFT = np.array([0.0, 0.002, 0.0, 0.004, 0.0, 0.003])  # rad, m a step: three times what the graph believes

    @pytest.mark.parametrize(("scene", "count", "step", "period"), [("loop", 52, 11, 420), ("turn", 42, 11, 330)])
    def test_revisits_are_found(self, scene: str, count: int, step: int, period: int) -> None:
        truth = walk(scene, count, step)
        found = searched(truth, drifting(truth, self.DRIFT))
        back = period // step + 2  # keyframes until two have been seen twice
        assert all(len(findings.closures) == 1 for findings in found[back:])
        assert not any(findings.closures for findings in found[: back - 5])
        rad, metres, squares = errors(truth, found).T
        assert rad.max() < MAX_RAD and metres.max() < MAX_M
        assert squares.max() < 25.0 and squares.mean() < 6.0

    def test_hardly_any_texture(self) -> None:
        truth = walk("blank", 56, 17)
        found = searched(truth, drifting(truth, self.DRIFT))
        assert not any(findings.closures for findings in found[:42])  # 720 frames a round
        rad, metres, _ = errors(truth, found).T
        assert len(rad) >= 3 and rad.max() < MAX_RAD and metres.max() < MAX_M

    def test_equal_doors_are_no_loop(self) -> None:
        """Even where the graph rules nothing out."""
        truth = walk("corridor", 70, 16)
        found = searched(truth, drifting(truth, self.DRIFT), changed(CONFIG, understated=1000.0))
        assert all(findings == Findings((), 0, 0) for findings in found)

    def test_the_same_every_time(self) -> None:
        truth = walk("turn", 42, 11)
        first, second = (searched(truth, truth.T_cw) for _ in range(2))
        for a, b in zip(first, second, strict=True):
            assert (a.inconsistent, a.gated, len(a.closures)) == (b.inconsistent, b.gated, len(b.closures))
            for one, other in zip(a.closures, b.closures, strict=True):
                assert one.earlier == other.earlier
                assert_array_equal(one.measured.T_ji, other.measured.T_ji)
                assert_array_equal(one.measured.motion.information, other.measured.motion.information)

    def test_one_keyframe_alone_is_not_believed(self) -> None:
        truth = walk("turn", 42, 11)
        found = searched(truth, truth.T_cw, changed(CONFIG, partner_m=1e-4))
        assert not any(findings.closures for findings in found)
        assert all(findings.inconsistent >= 2 for findings in found[-5:])

    def copied(self, step_m: float) -> Findings:
        """A place that looks exactly like one seen before, when the graph says the camera has gone on all the time."""
        truth = walk("room", 4, 8)
        away = np.eye(4)
        away[0, 3] = step_m * CONFIG.loop_gap
        blank = [np.full((240, 320, 3), 0.5, np.float32), np.ones((240, 320), np.float32)]
        images = [[f.colour, f.depth_m] for f in truth.frames[:3]] + [blank] * CONFIG.loop_gap
        images += [[truth.frames[1].colour, truth.frames[1].depth_m]]
        T_cw = {k: truth.T_cw[min(k, 2)] for k in range(len(images))}
        T_cw[len(images) - 1] = truth.T_cw[1] @ away
        search = LoopSearch(CAMERA, NOISE, CONFIG)
        return [search.find(k, *image, T_cw, believed(T_cw)) for k, image in enumerate(images)][-1]

    def test_a_perfect_copy_is_told_apart_by_how_far_it_is(self) -> None:
        assert self.copied(0.3) == Findings((), 0, gated=1)
        (closure,) = self.copied(0.02).closures
        assert closure.earlier == 1

    def test_images_without_features(self) -> None:
        search = LoopSearch(CAMERA, NOISE, CONFIG)
        T_cw = dict.fromkeys(range(30), np.eye(4))
        nothing = np.zeros((240, 320, 3), np.float32), np.zeros((240, 320), np.float32)
        assert {search.find(k, *nothing, T_cw, believed(T_cw)) for k in range(30)} == {Findings((), 0, 0)}

    def test_the_graph_closes_the_loop(self) -> None:
        truth = walk("loop", 52, 11)
        graph = PoseGraph(SolvingSettings())
        search = LoopSearch(CAMERA, NOISE, CONFIG)
        odometry = drifting(truth, self.DRIFT)
        information = np.diag(STEP_SIGMA**-2.0)
        for k, frame in enumerate(truth.frames):
            if k == 0:
                graph.add_first(0, odometry[0])
            else:
                motion = RelativePose(odometry[k] @ inverse(odometry[k - 1]), information)
                graph.add_keyframe(k, {k - 1: motion})
            estimate = graph.optimise()
            T_cw = dict(zip(estimate.keyframes.tolist(), estimate.T_cw, strict=True))
            for closure in search.find(k, frame.colour, frame.depth_m, T_cw, graph.relative).closures:
                graph.add_closure(closure.earlier, k, closure.measured.motion)
        assert graph.closure_count > 10
        before = se3_log(odometry[51] @ inverse(odometry[13]) @ inverse(truth.motion(13, 51)))
        after = se3_log(graph.optimise().T_cw[51] @ inverse(graph.estimate().T_cw[13]) @ inverse(truth.motion(13, 51)))
        assert np.linalg.norm(before[:3]) > 0.05 and np.linalg.norm(before[3:]) > 0.05
        assert np.linalg.norm(after[:3]) < 0.01 and np.linalg.norm(after[3:]) < 0.02
