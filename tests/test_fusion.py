"""Fusion of keyframes' depth and normals into the map: closed-form truths, and what it does to a map's error."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.mapper import Mapper
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.map_settings import LossConfig, MappingConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import inverse, matrix_from_quat_wxyz, so3_exp, transform_points
from tgslam.mapping.fusion import depth_pyramid, fused_depth, sample, turned
from tgslam.types import Frame

SIGMA_PER_M2 = LossConfig().noise.per_m2

# Depth


def test_views_average_by_their_information() -> None:
    rng = np.random.default_rng(0)
    measured, information = rng.uniform(1.0, 2.0, (5, 40)), rng.uniform(1.0, 4.0, (5, 40))
    z, known = measured[0], information[0]
    for k in range(1, 5):
        before = z
        z, known, gain = fused_depth(z, known, measured[k], information[k])
        np.testing.assert_allclose(z, before + gain * (measured[k] - before), atol=1e-12)
    np.testing.assert_allclose(z, (information * measured).sum(0) / information.sum(0), atol=1e-12)
    np.testing.assert_allclose(known, information.sum(0), atol=1e-12)


def test_equal_views_weigh_less_and_less_down_to_a_least_gain() -> None:
    """As 1/n at first; a map that goes on for ever must still follow what it sees, so not all the way to zero."""
    z, known, gains = np.array([2.0]), np.array([100.0]), []
    for _ in range(100):
        z, known, gain = fused_depth(z, known, np.array([2.1]), np.array([100.0]))
        gains.append(gain[0])
    np.testing.assert_allclose(gains[:20], 1.0 / np.arange(2, 22))
    assert (np.diff(gains) <= 1e-15).all()
    np.testing.assert_allclose(gains[-60:], gains[-1])
    assert 0.01 < gains[-1] < 0.05
    assert gains[-1] == pytest.approx(100.0 / (known[0] + 100.0))


def test_one_near_view_outweighs_many_far_ones() -> None:
    """At a quarter of the distance sigma is a sixteenth: one view is as good as 256."""
    far, near = 1.0 / (SIGMA_PER_M2 * 4.0**2) ** 2, 1.0 / (SIGMA_PER_M2 * 1.0**2) ** 2
    z, known = np.array([4.05]), np.array([far])
    for _ in range(7):
        z, known, _ = fused_depth(z, known, np.array([4.05]), np.array([far]))
    z, known, gain = fused_depth(z, known, np.array([4.0]), np.array([near]))
    assert gain[0] == pytest.approx(256.0 / 264.0)
    assert z[0] == pytest.approx(4.0 + 0.05 * 8.0 / 264.0)


def test_a_guessed_depth_gives_way_to_the_first_measurement() -> None:
    z, known, gain = fused_depth(np.array([3.0]), np.array([0.0]), np.array([2.0]), np.array([50.0]))
    assert (z[0], known[0], gain[0]) == (2.0, 50.0, 1.0)


@pytest.mark.parametrize("information", [0.0, 1e-30, 1e5])
@pytest.mark.parametrize("measured_m", [0.0, 5.0, np.nan])
def test_a_view_without_evidence_changes_nothing(information: float, measured_m: float) -> None:
    """Nor may the map forget what it knows of rows that a keyframe says nothing of."""
    z, known, gain = fused_depth(np.array([2.0]), np.array([information]), np.array([measured_m]), np.array([0.0]))
    assert (z[0], known[0], gain[0]) == (2.0, information, 0.0)


# Sampling


def at(*pixels: tuple[int, int]) -> tuple[NDArray, NDArray]:
    """Columns u and rows v of pixels given as (u, v)."""
    return np.array([u for u, _ in pixels]), np.array([v for _, v in pixels])


def test_samples_are_means_over_blocks_of_the_wanted_size() -> None:
    rng = np.random.default_rng(1)
    depth_m = (2.0 + 0.01 * rng.random((16, 24))).astype(
        np.float32
    )  # one surface, as far as the halvings are concerned
    u, v = at((13, 6))
    for size_px, level in [(0.2, 0), (1.9, 0), (2.01, 1), (3.9, 1), (4.01, 2), (7.9, 2), (500.0, 2)]:
        found, width_px = sample(depth_pyramid(depth_m, 3), u, v, np.array([size_px]))
        side = 2**level
        row, column = 6 // side * side, 13 // side * side
        assert found[0] == pytest.approx(inverse_mean(depth_m[row : row + side, column : column + side]), abs=1e-6)
        assert width_px[0] == side


def inverse_mean(depth_m: NDArray[np.float32]) -> float:
    """Of inverse depth, which is affine on a plane."""
    return float(1.0 / np.mean(1.0 / depth_m.astype(np.float64)))


def test_every_sample_has_its_own_level() -> None:
    depth_m = np.arange(64, dtype=np.float32).reshape(8, 8) * np.float32(0.001) + 2
    u, v = at((5, 2), (5, 2), (0, 7))
    found, width_px = sample(depth_pyramid(depth_m, 3), u, v, np.array([4.5, 1.0, 2.5]))
    expected = [inverse_mean(depth_m[0:4, 4:8]), depth_m[2, 5], inverse_mean(depth_m[6:8, 0:2])]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_array_equal(width_px, [4, 1, 2])


def test_images_of_odd_size_can_be_sampled_to_their_last_pixel() -> None:
    depth_m = np.full((13, 7), 2.0, np.float32)
    depth_m[10:, 4:] = 2.02
    pyramid = depth_pyramid(depth_m, 3)
    assert [image.shape for image in pyramid] == [(13, 7), (6, 3), (3, 1)]
    found, _ = sample(pyramid, *at((6, 12), (6, 12), (6, 12)), np.array([1.0, 2.5, 5.0]))
    # what the halvings leave out belongs to the last block
    np.testing.assert_allclose(found, [2.02, 2.02, inverse_mean(depth_m[8:12, 0:4])], atol=1e-6)


def test_the_pyramid_ends_where_nothing_is_left_to_halve() -> None:
    assert [image.shape for image in depth_pyramid(np.full((5, 2), 1.0, np.float32), 9)] == [(5, 2), (2, 1)]
    assert len(depth_pyramid(np.full((64, 64), 1.0, np.float32), 2)) == 2


def test_holes_give_no_depth_and_do_not_pull_at_that_of_their_neighbours() -> None:
    depth_m = np.full((8, 8), 3.0, np.float32)
    depth_m[0:2, 0:2] = 0.0
    depth_m[3, 3] = 0.0
    pyramid = depth_pyramid(depth_m, 3)
    found, _ = sample(pyramid, *at((1, 1), (1, 1), (1, 1), (3, 3), (2, 2)), np.array([1.0, 2.5, 4.5, 1.0, 2.5]))
    np.testing.assert_allclose(found, [0.0, 0.0, 3.0, 0.0, 3.0])


# Normals

COMPONENTS = st.lists(st.floats(-1, 1), min_size=3, max_size=3)


def quaternions(n: int, seed: int = 0) -> NDArray[np.float64]:
    quat = np.random.default_rng(seed).normal(size=(n, 4))
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def third_axes(quat_wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    return matrix_from_quat_wxyz(quat_wxyz)[:, :, 2]


def normals_off(quat_wxyz: NDArray[np.float64], degrees: NDArray[np.float64], seed: int = 1) -> NDArray[np.float64]:
    """Unit normals so far off the third axes, to random sides."""
    axis = third_axes(quat_wxyz)
    side = np.cross(axis, np.random.default_rng(seed).normal(size=axis.shape))
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    angle = np.deg2rad(degrees)[:, None]
    return np.cos(angle) * axis + np.sin(angle) * side


def angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Between lines: 0 to 90 degrees."""
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.abs((a * b).sum(-1))))


def test_a_full_gain_reaches_the_normal_and_none_turns_nothing() -> None:
    quat = quaternions(50)
    normals = normals_off(quat, np.linspace(0, 59, 50))
    np.testing.assert_allclose(third_axes(turned(quat, normals, np.ones(50))), normals, atol=1e-12)
    np.testing.assert_allclose(turned(quat, normals, np.zeros(50)), quat, atol=1e-12)


def test_small_turns_go_by_the_gain() -> None:
    quat = quaternions(50)
    normals, gain = normals_off(quat, np.full(50, 2.0)), np.linspace(0.05, 0.95, 50)
    after = third_axes(turned(quat, normals, gain))
    np.testing.assert_allclose(angle_deg(after, normals), (1 - gain) * 2.0, atol=1e-3)
    np.testing.assert_allclose(angle_deg(after, third_axes(quat)), gain * 2.0, atol=1e-3)


def test_turning_does_not_spin_about_the_normal() -> None:
    """The whole rotation is no larger than the angle between the axes: texture along the surface stays in place."""
    quat = quaternions(50)
    after = turned(quat, normals_off(quat, np.linspace(1, 59, 50)), np.full(50, 0.5))
    rotation_deg = 2 * np.rad2deg(np.arccos(np.clip(np.abs((after * quat).sum(-1)), 0, 1)))
    np.testing.assert_allclose(rotation_deg, angle_deg(third_axes(after), third_axes(quat)), atol=1e-5)


def test_the_sign_of_a_normal_does_not_matter() -> None:
    quat = quaternions(50)
    normals, gain = normals_off(quat, np.linspace(0, 59, 50)), np.linspace(0, 1, 50)
    np.testing.assert_allclose(turned(quat, -normals, gain), turned(quat, normals, gain), atol=1e-12)


def test_normals_of_other_surfaces_and_missing_ones_turn_nothing() -> None:
    quat = quaternions(60)
    normals = normals_off(quat, np.linspace(60.5, 119.5, 60))
    normals[::3] = 0.0
    np.testing.assert_array_equal(turned(quat, normals, np.ones(60)), quat)


@given(st.integers(0, 10_000), COMPONENTS, st.floats(0, 1))
def test_a_turn_stays_a_rotation_and_never_leads_away_from_the_normal(
    seed: int, components: list[float], gain: float
) -> None:
    normal = np.array([components])
    assume(np.linalg.norm(normal) > 1e-2)
    normal /= np.linalg.norm(normal)
    quat = quaternions(1, seed)
    after = turned(quat, normal, np.array([gain]))
    assert np.linalg.norm(after) == pytest.approx(1.0, abs=1e-12)
    assert angle_deg(third_axes(after), normal)[0] <= angle_deg(third_axes(quat), normal)[0] + 1e-9


@given(COMPONENTS)
def test_what_is_turned_is_the_third_axis(components: list[float]) -> None:
    """Against a rotation matrix made by hand: from the z axis to the normal, about their cross product."""
    normal = np.array(components)
    normal[2] = np.abs(normal[2]) + np.linalg.norm(normal[:2]) + 0.1  # well within 60 degrees of z
    normal /= np.linalg.norm(normal)
    axis = np.cross([0.0, 0.0, 1.0], normal)
    sine = np.linalg.norm(axis)
    omega = axis / max(sine, 1e-12) * np.arctan2(sine, normal[2])
    found = turned(np.array([[1.0, 0.0, 0.0, 0.0]]), normal[None], np.ones(1))
    np.testing.assert_allclose(matrix_from_quat_wxyz(found)[0], so3_exp(omega), atol=1e-9)


# In the mapper


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", width=160, height=120, frames=720), seed=0)


def make_mapper(source: SyntheticSource) -> Mapper:
    """Without refinement: what then changes of the geometry is fusion's doing."""
    return Mapper(source.camera, MappingConfig(iterations=0, refine_poses=False))


def add(mapper: Mapper, source: SyntheticSource, frame: Frame, T_wc: NDArray[np.float64]) -> None:
    mapper.add(frame, inverse(T_wc) @ source.pose(0))


def off_sigmas(
    mapper: Mapper, source: SyntheticSource, T_cw: NDArray[np.float64], exact_m: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Depth errors, in sigmas of the sensor there, of the first keyframe's Gaussians that lie well inside surfaces."""
    camera = source.camera
    x = transform_points(T_cw, mapper.gaussians.host("mean"))
    first = (mapper.gaussians.host("birth_keyframe") == 0) & ~mapper.known("guessed") & (x[:, 2] > 0.05)
    x = x[first]
    u = (camera.fx * x[:, :1] / x[:, 2:] + camera.cx).astype(np.float32)
    v = (camera.fy * x[:, 1:2] / x[:, 2:] + camera.cy).astype(np.float32)
    box = np.ones((5, 5), np.uint8)
    bend_m = np.abs(cv2.dilate(exact_m, box) + cv2.erode(exact_m, box) - 2 * exact_m)  # 0 on planes, slanted or not
    inverse_z = cv2.remap(1 / exact_m, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[:, 0]
    edge = cv2.remap(bend_m / exact_m, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0)[:, 0]
    good = (edge < 0.01) & (inverse_z > 0)
    z = 1.0 / inverse_z[good].astype(np.float64)
    return (x[good, 2] - z) / (SIGMA_PER_M2 * z**2)


def test_keyframes_of_a_noisy_sensor_average_out(source: SyntheticSource) -> None:
    mapper, exact_m = make_mapper(source), source.clean(0).depth_m
    errors, known = [], []
    for index in range(0, 24, 4):
        add(mapper, source, source.read(index), source.pose(index))
        off = off_sigmas(mapper, source, np.eye(4), exact_m)
        assert len(off) > 2000
        errors.append(np.median(np.abs(off)))
        known.append(np.median(mapper.known("information")[mapper.gaussians.host("birth_keyframe") == 0]))
    assert (np.diff(errors) < 0).all()
    assert errors[-1] < 0.75 * errors[0]
    assert (np.diff(known) > 0).all()


def test_no_keyframe_makes_the_map_forget_what_it_measured(source: SyntheticSource) -> None:
    mapper = make_mapper(source)
    for index in range(0, 16, 4):
        add(mapper, source, source.read(index), source.pose(index))
    assert (mapper.known("information")[~mapper.known("guessed")] > 0).all()
    assert (mapper.known("information")[mapper.known("guessed")] == 0).all()


def test_a_near_view_corrects_what_was_seen_from_afar(source: SyntheticSource) -> None:
    """Three far views that agree on a wrong depth, then a near one: a plain mean would leave three quarters of it."""
    mapper = make_mapper(source)
    far, near = source.pose(0), source.pose(0)
    near[:3, 3] += 1.2 * near[:3, 2]  # m ahead: surfaces at 3 m come to 1.8 m
    T_cw = inverse(near) @ far
    exact_m = source._raycaster.view(near).depth_m
    residual = []
    for index, (T_wc, wrong_sigmas) in enumerate([(far, 2.0), (far, 2.0), (far, 2.0), (near, 0.0)]):
        colour, view = source._raycaster.render(T_wc)
        depth_m = view.depth_m + np.float32(wrong_sigmas * SIGMA_PER_M2) * view.depth_m**2
        add(mapper, source, Frame(index, index / 30, colour, depth_m), T_wc)
        off = off_sigmas(mapper, source, T_cw, exact_m)
        assert len(off) > 500
        residual.append(np.median(off))
    assert residual[0] > 4.0  # of the near view's small sigmas
    np.testing.assert_allclose(residual[1:3], residual[0], atol=0.1)
    assert abs(residual[3]) < 0.4 * residual[0]
