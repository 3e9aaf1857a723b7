"""The mapper: what it inserts, prunes and refines, and the keyframes that it keeps."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.mapper import Mapper
from tests.tiers import changed
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.map_settings import LossConfig, MappingConfig
from tgslam.config.plane_settings import PlanesConfig, StructureConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.device.stopwatch import Stopwatch
from tgslam.evaluation.image_metrics import psnr
from tgslam.geometry import inverse, se3_exp, se3_log, transform_points
from tgslam.kernels.simd import ALPHA_MIN
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframes import Keyframe
from tgslam.mapping.refinement import Refiner
from tgslam.mapping.surface import Projection
from tgslam.ops.rasterize import Rasterizer
from tgslam.ops.vector_adam import VectorAdam
from tgslam.planes.identity.codes import codes_of, read_ids
from tgslam.synthetic import sensor
from tgslam.types import Exposure, Frame, Gaussians, Rendering


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", width=160, height=120, frames=720), seed=0)


def make_mapper(source: SyntheticSource, **settings: Any) -> Mapper:
    return Mapper(source.camera, changed(MappingConfig(), **settings))


def true_T_cw(source: SyntheticSource, index: int) -> NDArray[np.float64]:
    """In the frame of the first camera, as in a run."""
    return inverse(source.pose(index)) @ source.pose(0)


def add(mapper: Mapper, source: SyntheticSource, frame: Frame, T_cw: NDArray | None = None, gain: float = 1.0) -> None:
    """A keyframe, by default at its true pose."""
    mapper.add(frame, true_T_cw(source, frame.index) if T_cw is None else T_cw, Exposure(gain))


def view(mapper: Mapper, T_cw: NDArray) -> Rendering:
    return Rasterizer(mapper.camera).render(mapper.gaussians, T_cw)


def mapped(source: SyntheticSource, indices: range, **settings: Any) -> Mapper:
    mapper = make_mapper(source, **settings)
    for index in indices:
        add(mapper, source, source.read(index))
    return mapper


def in_patch(source: SyntheticSource, means: NDArray, patch: tuple[slice, slice], margin_px: float = 1.0) -> NDArray:
    """[N] which points of the first camera's frame it sees inside the patch of pixels."""
    pixel = means[:, :2] / means[:, 2:] * source.camera.fx + [source.camera.cx, source.camera.cy]
    low = [patch[1].start + margin_px, patch[0].start + margin_px]
    high = [patch[1].stop - 1 - margin_px, patch[0].stop - 1 - margin_px]
    return (pixel >= low).all(1) & (pixel <= high).all(1) & (means[:, 2] > 0)


def surface_m(frame: Frame, source: SyntheticSource, means: NDArray) -> NDArray:
    """[N] the frame's depth where it sees the points, which lie inside its image."""
    pixel = np.rint(means[:, :2] / means[:, 2:] * source.camera.fx + [source.camera.cx, source.camera.cy]).astype(int)
    return frame.depth_m[pixel[:, 1], pixel[:, 0]]


PATCH = (slice(40, 80), slice(60, 100))


# Insertion


def test_the_first_keyframe_is_mapped_whole(source: SyntheticSource) -> None:
    mapper = make_mapper(source, iterations=0)
    add(mapper, source, source.read(0))
    rendering = view(mapper, np.eye(4))
    assert (rendering.opacity > 0.9).mean() > 0.97
    assert psnr(rendering.colour, source.clean(0).colour) > 25.5


def test_what_the_map_shows_already_is_not_inserted_again(source: SyntheticSource) -> None:
    mapper = make_mapper(source)
    add(mapper, source, source.read(0))
    first = mapper.gaussians.count
    for index in range(1, 4):
        add(mapper, source, replace(source.read(0), index=index), np.eye(4))
    born = np.bincount(mapper.gaussians.host("birth_keyframe"))
    assert born[0] > 4000
    assert born[1:].sum() < 0.03 * born[0]
    assert mapper.gaussians.count < 1.015 * first


def test_a_new_area_is_inserted_where_it_is(source: SyntheticSource) -> None:
    mapper = make_mapper(source, iterations=0)
    add(mapper, source, source.clean(0))
    T_cw = true_T_cw(source, 60)
    was_open = view(mapper, T_cw).opacity < 0.5
    add(mapper, source, source.clean(60))
    rendering = view(mapper, T_cw)
    assert 0.1 < was_open.mean() < 0.6
    assert (rendering.opacity[was_open] > 0.8).mean() > 0.97
    new = mapper.gaussians.host("birth_keyframe") == 1
    x = transform_points(T_cw, mapper.gaussians.host("mean")[new])
    u = np.rint(x[:, :2] / x[:, 2:] * source.camera.fx + [source.camera.cx, source.camera.cy]).astype(int)
    assert was_open[u[:, 1], u[:, 0]].mean() > 0.85  # else it stands in front of what the map has there


def test_what_stands_in_front_of_the_map_is_inserted(source: SyntheticSource) -> None:
    mapper = make_mapper(source, iterations=0)
    frame = source.clean(0)
    add(mapper, source, frame)
    before = mapper.gaussians.count
    depth_m, colour = frame.depth_m.copy(), frame.colour.copy()
    depth_m[PATCH] *= 0.6
    colour[PATCH] = (1.0, 0.0, 0.0)
    add(mapper, source, replace(frame, index=1, depth_m=depth_m, colour=colour), np.eye(4))
    new = mapper.gaussians.host("birth_keyframe") == 1
    inside = in_patch(source, mapper.gaussians.host("mean")[new], PATCH)
    means = mapper.gaussians.host("mean")[new][inside]
    off_m = np.abs(means[:, 2] - 0.6 * surface_m(frame, source, means))
    assert np.median(off_m) < 0.01  # the rest are cells at the edges of what stands behind
    assert inside.sum() >= 25  # 40 x 40 pixels in the largest cells
    assert (~inside).sum() < 0.03 * before
    rendering = view(mapper, np.eye(4))
    inner = (slice(48, 72), slice(68, 92))
    # A fresh surface is not quite opaque: what stands behind it shines through in colour and depth
    error_m, gap_m = np.abs(rendering.depth_m - depth_m)[inner], (frame.depth_m - depth_m)[inner]
    assert np.median(error_m) < 0.1 * np.median(gap_m)
    assert np.abs(rendering.colour[inner].mean((0, 1)) - [1.0, 0.0, 0.0]).max() < 0.1


def test_holes_of_the_depth_image_are_mapped_at_a_guess(source: SyntheticSource) -> None:
    mapper = make_mapper(source, iterations=0)
    frame = source.clean(0)
    depth_m = frame.depth_m.copy()
    depth_m[50:60, 70:80] = 0.0
    add(mapper, source, replace(frame, depth_m=depth_m))
    rendering = view(mapper, np.eye(4))
    hole = (slice(50, 60), slice(70, 80))
    assert rendering.opacity[hole].min() > 0.7
    assert np.median(np.abs(rendering.depth_m - frame.depth_m)[hole] / frame.depth_m[hole]) < 0.1


def test_a_guess_does_not_hang_before_a_camera_that_goes_on(source: SyntheticSource) -> None:
    """What is out of the sensor's range is mapped at the range's end; from nearer, the next guess is farther."""
    mapper, frame = make_mapper(source, iterations=0), source.clean(0)
    columns = np.abs(np.arange(source.camera.width) - source.camera.cx)
    wall_m = np.broadcast_to(1.0 / np.maximum(columns / source.camera.fx, 0.2), frame.depth_m.shape)  # at x = +-1 m
    depth_m = np.where(wall_m < 4.5, wall_m, 0.0).astype(np.float32)
    nearest_m = []
    for ahead_m in (0.0, 1.0, 2.0, 3.0):
        forward = se3_exp([0.0, 0.0, 0.0, 0.0, 0.0, -ahead_m])
        add(mapper, source, replace(frame, depth_m=depth_m), forward)
        in_hole = mapper.known("guessed") & (np.abs(mapper.gaussians.host("mean")[:, :2]) < 0.3).all(axis=1)
        assert in_hole.any()
        nearest_m.append(mapper.gaussians.host("mean")[in_hole, 2].min() - ahead_m)
    assert min(nearest_m) > 0.75 * nearest_m[0]


def test_a_static_scene_seen_for_long_does_not_fill_up(source: SyntheticSource) -> None:
    mapper = make_mapper(source, iterations=8)
    exact, (colour, geometry) = source.clean(0), source._exposed(0)
    counts = []
    for index in range(12):
        rng = np.random.default_rng(index)
        noisy_m = sensor.noisy_depth(exact.depth_m, geometry.cosine, rng)
        frame = Frame(index, index / 30, sensor.noisy_colour(colour, rng), noisy_m)
        add(mapper, source, frame, np.eye(4))
        counts.append(mapper.gaussians.count)
    assert max(counts) < 1.05 * counts[0]


# Pruning


def test_floaters_go_once_two_keyframes_have_seen_through_them(source: SyntheticSource) -> None:
    mapper = make_mapper(source)
    frame = source.read(0)
    spoiled_m = frame.depth_m.copy()
    spoiled_m[PATCH] *= 0.5  # somebody walked by
    add(mapper, source, replace(frame, depth_m=spoiled_m))
    counts = [floating(mapper, source).sum()]
    for index in (3, 6, 9):
        add(mapper, source, source.read(index))
        counts.append(floating(mapper, source).sum())
    assert counts[0] > 100
    assert counts[1] > 0.9 * counts[0]  # one keyframe against one is no verdict
    assert counts[-1] == 0


def floating(mapper: Mapper, source: SyntheticSource) -> NDArray[np.bool_]:
    """[N] Gaussians well in front of what the first camera truly sees inside the patch."""
    means = mapper.gaussians.host("mean").astype(np.float64)
    result = in_patch(source, means, PATCH)
    result[result] = means[result, 2] < 0.75 * surface_m(source.clean(0), source, means[result])
    return result


def test_what_never_shows_goes(source: SyntheticSource) -> None:
    mapper = make_mapper(source, prune_weight_px=0.5)
    add(mapper, source, source.read(0))
    seen = mapper.gaussians.gaussians()
    middle = in_patch(source, seen.mean, (slice(30, 90), slice(40, 120)))
    behind = Gaussians(**{field.name: getattr(seen, field.name)[middle] for field in fields(Gaussians)})
    # Small ones: a fresh surface is not quite opaque, and what shines through counts by its area
    behind = replace(behind, mean=1.3 * behind.mean, log_scale=behind.log_scale - np.float32(2.0))
    marked = replace(behind, plane_id=np.full(middle.sum(), 99, np.int32))
    mapper.gaussians.append(marked)
    for index in (3, 6):
        add(mapper, source, source.read(index))
    left = mapper.gaussians.host("plane_id") == 99
    assert middle.sum() > 500
    assert left.sum() < 0.02 * middle.sum()
    assert (mapper.gaussians.host("birth_keyframe")[~left] == 0).sum() > 0.9 * len(seen)


def test_gaussians_that_have_faded_or_are_not_finite_go(source: SyntheticSource) -> None:
    mapper = make_mapper(source)
    add(mapper, source, source.read(0))
    count = mapper.gaussians.count
    faded = mapper.gaussians.gaussians()
    faded.opacity_logit[:10] = -6.0
    faded.mean[10:15] = np.nan
    mapper.gaussians.keep(np.zeros(count, bool))
    mapper.gaussians.append(faded)
    mapper.finish()
    assert count - 20 < mapper.gaussians.count <= count - 15
    assert np.isfinite(mapper.gaussians.host("mean")).all()


@pytest.mark.parametrize("identity", ["colour", "scalar"])
def test_new_gaussians_show_the_identity_of_their_plane(source: SyntheticSource, identity: str) -> None:
    structure = StructureConfig(identity=identity)
    mapper = Mapper(source.camera, MappingConfig(iterations=0), PlanesConfig(enabled=True), structure)
    add(mapper, source, source.read(0))
    ids = mapper.gaussians.host("plane_id")
    assert len(np.unique(ids)) > 3
    shown = 1.0 / (1.0 + np.exp(-mapper.gaussians.host("embedding")))
    right = np.isclose(shown, codes_of(ids, structure), atol=0.021).all(axis=1)
    assert right.mean() > 0.97  # `label` has another look at rims


# Refinement


@pytest.mark.parametrize("optimizer", ["relaxation", "adam"])
def test_refinement_lowers_the_loss_and_raises_the_psnr(source: SyntheticSource, optimizer: str) -> None:
    mapper = make_mapper(source, iterations=0, optimizer=optimizer)
    add(mapper, source, source.read(0))
    before_db = psnr(view(mapper, np.eye(4)).colour, source.clean(0).colour)
    losses = [mapper.refinement.refiner.step(mapper.keyframes[0]).loss.value for _ in range(20)]
    assert losses[5] < 0.9 * losses[0]
    assert losses[-1] < 0.65 * losses[0]
    assert psnr(view(mapper, np.eye(4)).colour, source.clean(0).colour) > before_db + 4.0


def test_a_stopwatch_takes_the_stages_of_an_iteration(source: SyntheticSource) -> None:
    mapper = make_mapper(source, iterations=0)
    add(mapper, source, source.read(0))
    stopwatch, gaussians = Stopwatch(), GaussianMap.from_gaussians(mapper.gaussians.gaussians())
    Refiner(gaussians, source.camera, MappingConfig(), LossConfig(), stopwatch=stopwatch).step(mapper.keyframes[0])
    assert list(stopwatch.seconds) == ["forward", "loss", "backward", "update"]
    assert all(seconds > 0 for seconds in stopwatch.seconds.values())


@pytest.mark.parametrize("optimizer", ["relaxation", "adam"])
def test_the_final_refinement_sharpens_frames_that_mapping_never_saw(source: SyntheticSource, optimizer: str) -> None:
    mapper = mapped(source, range(0, 30, 10), optimizer=optimizer, refine_poses=False)
    before_db, poses = unseen_psnr(mapper, source), [k.T_cw.copy() for k in mapper.keyframes]
    mapper.finish()
    assert unseen_psnr(mapper, source) > before_db + 2.0
    assert all((k.T_cw == T_cw).all() for k, T_cw in zip(mapper.keyframes, poses, strict=True))


@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({"final_iterations": 1}, 6),  # final_rounds for each of the three
        ({"final_iterations": 7}, 9),  # whole rounds
        ({"final_iterations": 7, "budget": 2.0}, 15),
        ({"final_iterations": 7, "budget": 0.5}, 6),
        ({"final_iterations": 0}, 0),
    ],
)
def test_every_keyframe_has_its_turns_in_the_final_pass(
    source: SyntheticSource, monkeypatch: pytest.MonkeyPatch, settings: dict[str, float], steps: int
) -> None:
    mapper = mapped(source, range(0, 30, 10), iterations=0, final_rounds=2, **settings)
    seen: list[int] = []
    monkeypatch.setattr(
        mapper.refinement.refiner, "step", lambda keyframe, *, colour_pace, final: seen.append(keyframe.index)
    )
    mapper.refinement.finish()
    assert len(seen) == steps
    assert len(set(np.unique(seen, return_counts=True)[1].tolist())) <= 1


def unseen_psnr(mapper: Mapper, source: SyntheticSource) -> float:
    frames = [source.clean(index) for index in (5, 15)]
    return float(np.mean([psnr(view(mapper, true_T_cw(source, f.index)).colour, f.colour) for f in frames]))


def test_the_final_refinement_learns_what_keyframes_show_of_planes_in_the_end(source: SyntheticSource) -> None:
    structure, config = changed(StructureConfig(), pgi_interval=1), MappingConfig(iterations=0, final_iterations=8)
    mapper = Mapper(source.camera, config, PlanesConfig(enabled=True), structure)
    for index in (0, 10):
        add(mapper, source, source.read(index))
    first, second = mapper.keyframes
    assert first.labels is not None
    shown = first.labels.image()
    # As if neither the keyframes' own segments had said anything, nor the Gaussians been born with an identity
    for one in (first, second):
        one.show(np.full_like(shown, -1))
    mapper.gaussians.write("embedding", slice(0, mapper.gaussians.count), np.zeros((mapper.gaussians.count, 3)))
    mapper.finish()
    planar = shown >= 0
    assert (first.labels.image()[planar] == shown[planar]).mean() > 0.95
    images = mapper.refinement.refiner.rasterizer.forward(mapper.gaussians, first.T_cw, with_embedding=True)
    found = read_ids(images.embedding, images.opacity, np.unique(shown[planar]), structure)
    assert (found[planar] == shown[planar]).mean() > 0.8


def test_the_final_refinement_can_be_off(source: SyntheticSource) -> None:
    mapper = mapped(source, range(0, 20, 10), final_iterations=0)
    before = mapper.gaussians.gaussians()
    mapper.finish()
    after = mapper.gaussians.gaussians()
    if len(after) == len(before):  # pruning alone may take some
        assert all(np.array_equal(getattr(before, f.name), getattr(after, f.name)) for f in fields(Gaussians))
    else:
        assert np.isin(after.mean[:, 0], before.mean[:, 0]).all()


def test_the_final_pass_leaves_the_mean_brightness_of_the_views(source: SyntheticSource) -> None:
    """Frames that differ in brightness alone: none of them, the last one least of all, has the map to itself."""
    frame = source.read(0)
    gains = np.array([0.8, 0.9, 1.0, 1.1, 1.2], np.float32)
    frames = [replace(frame, index=k, colour=np.clip(frame.colour, 0, 0.8) * gain) for k, gain in enumerate(gains)]
    for last in range(0, 5, 2):
        mapper = make_mapper(source)
        for one in np.roll(np.arange(5), 4 - last):
            mapper.add(frames[one], np.eye(4))
        mapper.finish()
        brightness = view(mapper, np.eye(4)).colour.mean() / np.clip(frame.colour, 0, 0.8).mean()
        assert brightness == pytest.approx(1.0, abs=0.03)


def test_pose_refinement_takes_a_disturbed_keyframe_back(source: SyntheticSource) -> None:
    mapper = mapped(source, range(0, 25, 5), refine_poses=False, iterations=30)
    middle, refiner = mapper.keyframes[2], mapper.refinement.refiner
    T_cw = se3_exp([0, 0, 0, 0.004, -0.003, 0]) @ middle.T_cw
    before, adam = (flow_px(source, middle, T_cw), shift_mm(source, middle, T_cw)), VectorAdam([0.0003] * 6)
    for step in range(75):
        if step % 5 == 2:
            T_cw = se3_exp(adam.step(refiner.step(middle, T_cw).g_pose)) @ T_cw
        else:
            refiner.step(mapper.keyframes[step % 5])
    after = flow_px(source, middle, T_cw), shift_mm(source, middle, T_cw)
    assert after[0] < 0.3 * before[0]
    assert after[1] < 0.8 * before[1]


def shift_mm(source: SyntheticSource, frame: Keyframe, T_cw: NDArray) -> float:
    return 1000 * float(np.linalg.norm(se3_log(T_cw @ inverse(true_T_cw(source, frame.index)))[3:]))


def flow_px(source: SyntheticSource, frame: Keyframe, T_cw: NDArray) -> float:
    """How far the keyframe's pose error moves what it sees in its image: median over pixels."""
    camera, depth_m = source.camera, source.clean(frame.index).depth_m
    v, u = np.indices(depth_m.shape)
    x = camera.points_at(u, v, depth_m)
    moved = transform_points(T_cw @ inverse(true_T_cw(source, frame.index)), x)
    return float(np.median(np.linalg.norm(camera.fx * (moved / moved[..., 2:] - x / x[..., 2:]), axis=-1)))


def test_only_keyframes_of_the_window_move_and_never_the_first(source: SyntheticSource) -> None:
    mapper = make_mapper(source, window=2, anchors="random", anchor_count=2, iterations=8, refine_poses=True)
    poses: list[list[NDArray]] = []
    for index in range(0, 20, 5):
        add(mapper, source, source.read(index))
        poses.append([k.T_cw.copy() for k in mapper.keyframes])
    assert (poses[-1][0] == poses[0][0]).all()
    assert (poses[-1][1] == poses[-2][1]).all()  # has left the window
    assert not (poses[-1][2] == poses[-2][2]).all()
    assert all(np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12) for T in poses[-1])


def test_poses_stay_when_they_are_not_to_be_refined(source: SyntheticSource) -> None:
    mapper = mapped(source, range(0, 15, 5), refine_poses=False)
    assert all((k.T_cw == true_T_cw(source, k.index)).all() for k in mapper.keyframes)


# Exposure and storage


def test_a_dark_keyframe_is_mapped_at_the_maps_brightness(source: SyntheticSource) -> None:
    mapper = make_mapper(source)
    frame = source.read(0)
    add(mapper, source, replace(frame, colour=0.5 * frame.colour), gain=2.0)
    rendering = view(mapper, np.eye(4))
    assert rendering.colour.mean() == pytest.approx(frame.colour.mean(), rel=0.02)
    assert psnr(rendering.colour, frame.colour) > 28.0


def test_keyframes_keep_their_images_in_five_bytes_a_pixel_and_their_planes_in_one() -> None:
    colour = (np.arange(256 * 3, dtype=np.float32) / (256 * 3 - 1)).reshape(16, 16, 3)
    depth_m = np.linspace(0.0, 13.5, 256, dtype=np.float32).reshape(16, 16)
    kept = Keyframe(Frame(3, 0.25, colour, depth_m), np.eye(4), Exposure(1.5, 0.1), np.eye(6))
    assert np.abs(kept.colour() - colour).max() <= 0.5 / 255 + 1e-6
    far = depth_m > 13.107
    assert np.abs(kept.depth_m() - depth_m)[~far].max() <= 0.0001 + 1e-6
    assert far.any()
    assert (kept.depth_m()[far] == 0).all()
    assert (kept.index, kept.timestamp_s, kept.exposure) == (3, 0.25, Exposure(1.5, 0.1))
    assert kept.colour().dtype == kept.depth_m().dtype == np.float32
    stored = [value for value in vars(kept).values() if isinstance(value, np.ndarray) and value.size >= 256]
    assert sum(array.nbytes for array in stored) == 5 * 256
    kept.show(np.where(far, 70_000, -1))
    assert kept.labels is not None and kept.labels.places.nbytes == 256
    again = Keyframe(Frame(3, 0.25, kept.colour(), kept.depth_m()), np.eye(4), Exposure(), np.eye(6))
    np.testing.assert_array_equal(again.colour(), kept.colour())
    np.testing.assert_array_equal(again.depth_m(), kept.depth_m())


def corrections(count: int) -> dict[int, NDArray[np.float64]]:
    """As a pose graph takes back drift of 0.9 mrad and 2 mm a keyframe: the longer ago, the less one moves."""
    return {k: se3_exp(np.array([0.0005, -0.0007, 0.0003, 0.0015, -0.001, 0.001]) * k) for k in range(count)}


def own_depth_off_m(mapper: Mapper, keyframe: Keyframe) -> float:
    """Median distance of what the map shows at a keyframe's pose from what the keyframe measured."""
    shown, measured = view(mapper, keyframe.T_cw).depth_m, keyframe.depth_m()
    both = (shown > 0) & (measured > 0)
    return float(np.median(np.abs(shown - measured)[both]))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_map_follows_its_keyframes(seed: int) -> None:
    """Issue: depth of old keyframes changes by less than 2 mm (median), PSNR comes back to within 0.3 dB.

    Of each old keyframe; also of the first one, which refinement of the window hardly sees.
    """
    source = SyntheticSource(SyntheticConfig(scene="room", width=160, height=120, frames=720), seed=seed)
    mapper = make_mapper(source, window=3, iterations=9)
    for index in range(0, 40, 8):
        add(mapper, source, source.read(index))
    old = mapper.keyframes[:4]
    before = [view(mapper, k.T_cw) for k in old]
    off_m = [own_depth_off_m(mapper, k) for k in old]
    quality = [psnr(view.colour, k.colour()) for view, k in zip(before, old, strict=True)]
    poses = [k.T_cw.copy() for k in mapper.keyframes]
    mapper.follow(corrections(5))
    after = [view(mapper, k.T_cw) for k in old]
    for k, (was, now) in enumerate(zip(before, after, strict=True)):
        both = (was.depth_m > 0) & (now.depth_m > 0)
        assert np.median(np.abs(was.depth_m - now.depth_m)[both]) < 0.002
        assert own_depth_off_m(mapper, old[k]) < off_m[k] + 0.001
        assert psnr(now.colour, old[k].colour()) > quality[k] - 0.2
    np.testing.assert_allclose(old[0].T_cw, poses[0], atol=1e-9)
    moved = inverse(mapper.keyframes[-1].T_cw) @ poses[-1]
    np.testing.assert_allclose(moved, corrections(5)[4], atol=0.005)  # refinement moves the window a little


def test_gaussians_move_by_what_each_keyframe_has_said_of_their_depth(source: SyntheticSource) -> None:
    """What the second keyframe has not measured stays with the first one, the rest moves by its share of what is known,
    in eighths."""
    mapper, frame = make_mapper(source, iterations=0), source.read(0)
    add(mapper, source, frame)
    alone, count = mapper.known("information"), mapper.gaussians.count
    numbered = np.zeros((count, 3), np.float32)
    numbered[:, 0] = np.arange(count)
    mapper.gaussians.write("embedding", slice(0, count), numbered)  # some will go
    hidden = replace(frame, index=1, depth_m=frame.depth_m.copy())
    hidden.depth_m[PATCH] = 0.0
    add(mapper, source, hidden, np.eye(4))
    rows = np.flatnonzero((mapper.gaussians.host("birth_keyframe") == 0) & (mapper.known("information") > 0))
    share = 1.0 - alone[mapper.gaussians.host("embedding")[rows, 0].astype(int)] / mapper.known("information")[rows]
    before = mapper.gaussians.host("mean")[rows]
    mapper.follow({1: se3_exp([0.0, 0.0, 0.0, 0.008, 0.0, 0.0])})
    moved_m = mapper.gaussians.host("mean")[rows] - before
    unseen = in_patch(source, before, PATCH)
    assert unseen.sum() > 50
    np.testing.assert_allclose(moved_m[unseen], 0.0, atol=1e-6)
    assert np.median(share) > 0.2 and len(rows) > 4000
    np.testing.assert_allclose(moved_m[:, 0], 0.008 * share, atol=0.001 + 1e-6)
    np.testing.assert_allclose(moved_m[:, 1:], 0.0, atol=1e-6)


def test_a_loop_that_closes_tears_no_view() -> None:
    """Drift of 3 cm and 6 mrad is spread over a walk. Depth stays with each keyframe's own, and so do the colours,
    nearly, before anything is refined."""
    walk = SyntheticSource(SyntheticConfig(scene="loop", width=160, height=120, frames=720), seed=0)
    mapper = mapped(walk, range(0, 240, 12), iterations=6)
    off_m = [own_depth_off_m(mapper, k) for k in mapper.keyframes]
    quality = [psnr(view(mapper, k.T_cw).colour, k.colour()) for k in mapper.keyframes]
    drift = np.array([0.07, -0.09, 0.04, 0.75, -0.5, 0.45]) * 0.03
    mapper.map.move({k: se3_exp(drift * k / 19) for k in range(20)})
    for keyframe_, off, was in zip(mapper.keyframes, off_m, quality, strict=True):
        assert own_depth_off_m(mapper, keyframe_) < off + 0.001
        assert psnr(view(mapper, keyframe_.T_cw).colour, keyframe_.colour()) > was - 0.6


def test_a_common_motion_of_all_keyframes_changes_no_view_and_refines_nothing(source: SyntheticSource) -> None:
    mapper = mapped(source, range(0, 24, 8))
    before = [view(mapper, k.T_cw).colour for k in mapper.keyframes]
    views = mapper.known("views")
    mapper.follow(dict.fromkeys(range(3), se3_exp([0.1, -0.2, 0.3, 1.0, 0.5, -2.0])))
    for was, k in zip(before, mapper.keyframes, strict=True):
        change = np.abs(view(mapper, k.T_cw).colour - was)
        # by rounding, a splat at the threshold of what is drawn may come or go
        assert change.max() < ALPHA_MIN and np.quantile(change, 0.999) < 1e-4
    np.testing.assert_array_equal(mapper.known("views"), views)


def test_the_size_in_the_image_is_that_of_the_longest_axis(source: SyntheticSource) -> None:
    """A long thin Gaussian along the line of sight is small there, and large seen from the side."""
    mapper, T_cw = make_mapper(source), np.eye(4)
    one = {
        "mean": [[0.0, 0.0, 2.0], [0.5, 0.0, 2.0]], "log_scale": np.log([[0.01, 0.01, 0.3]] * 2),
        "quat_wxyz": [[1.0, 0, 0, 0]] * 2, "opacity_logit": [2.0] * 2, "colour": [[0.5] * 3] * 2,
        "embedding": [[0.0] * 3] * 2,
    }  # fmt: skip
    rows = {name: np.array(value, np.float32) for name, value in one.items()}
    mapper.gaussians.append(Gaussians(**rows, plane_id=np.full(2, -1, np.int32), birth_keyframe=np.zeros(2, np.int32)))
    rows = np.arange(2)
    ahead = Projection(mapper.gaussians, source.camera, T_cw).axes_px(mapper.gaussians, rows).max(axis=1)
    fx = source.camera.fx
    np.testing.assert_allclose(ahead, [0.01 * fx / 2, 0.25 * 0.3 * fx / 2], rtol=1e-3)
    aside = se3_exp([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0])
    aside[:3, 3] = np.array([0.0, 0.0, 3.0]) - aside[:3, :3] @ [0.0, 0.0, 2.0]
    assert Projection(mapper.gaussians, source.camera, aside).axes_px(mapper.gaussians, rows)[0].max() == pytest.approx(
        0.3 * fx / 3, rel=0.01
    )
