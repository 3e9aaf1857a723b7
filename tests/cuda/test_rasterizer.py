"""The CUDA rasterizer against that of the CPU and against the float64 twin."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import GRIDS, Devices, Results
from tests.cuda.scenarios import rasterizer
from tests.cuda.scenarios.rasterizer import IMAGES, SCENES, functional
from tests.reference.projection import NAMES, parameters
from tests.reference.rasterize import Derivatives, render, undecided
from tests.test_render import ATOL, BAND, relative_error
from tgslam.kernels.simd import T_MIN
from tools.cudacheck.environment import Grid

pytestmark = pytest.mark.cuda_check

EARLY_STOP = {"opaque", "opaque_front", "growing", "saturated"}  # each device stops at its own splat, below T_MIN
IMAGE_ATOL = {"needles": ATOL} | dict.fromkeys(EARLY_STOP, 4.0 * T_MIN)  # a needle's exponent has large terms
NOTHING = {"behind", "empty"}
SPLIT = [pytest.param(e, c, id=f"{'' if e else 'no-'}embedding-{'' if c else 'no-'}curvature")
         for e, c in ((True, True), (True, False), (False, True), (False, False))]  # fmt: skip


def assert_images_agree(found: Results, expected: Results, keep: np.ndarray, atol: float) -> None:
    for name in IMAGES:
        assert np.isfinite(found[name]).all(), name
        np.testing.assert_allclose(found[name][keep], expected[name][keep], rtol=0.0, atol=atol, err_msg=name)


def assert_gradients_agree(found: Results, expected: Results, rtol: float) -> None:
    """Norm-wise for each parameter."""
    for name in (n for n in expected if n.startswith("grad_")):
        assert np.isfinite(found[name]).all(), name
        if expected[name].any():
            assert relative_error(found[name], expected[name]) < rtol, name
        else:
            assert not found[name].any(), name


def decided(scene: str) -> np.ndarray:
    """[H, W] pixels whose alphas are all clear of the thresholds."""
    chosen = SCENES[scene]()
    return ~undecided(parameters(chosen.gaussians), chosen.T_cw, chosen.camera, BAND)


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("scene", sorted(SCENES))
def test_both_devices_agree(devices: Devices, grid: Grid, scene: str) -> None:
    cpu, cuda = devices.both(rasterizer.render, grid, scene=scene)
    assert_images_agree(cuda, cpu, decided(scene), atol=IMAGE_ATOL.get(scene, 1e-5))
    assert_gradients_agree(cuda, cpu, rtol=2e-3 if scene in EARLY_STOP else 1e-4)
    assert cpu["opacity"].any() == (scene not in NOTHING)


@pytest.mark.parametrize(("with_embedding", "with_curvature"), SPLIT)
def test_only_what_is_asked_for(devices: Devices, with_embedding: bool, with_curvature: bool) -> None:
    arguments = {"with_embedding": with_embedding, "with_curvature": with_curvature}
    cpu, cuda = devices.both(rasterizer.render, Grid.DEFAULT, **arguments)
    assert_images_agree(cuda, cpu, decided("ordinary"), atol=1e-5)
    assert_gradients_agree(cuda, cpu, rtol=1e-4)
    assert cuda["grad_embedding"].any() == with_embedding
    assert cuda["grad_curvature"].any(axis=0).all() == with_curvature


@pytest.mark.parametrize("scene", ["ordinary", "saturated", "crowded", "needles", "equal_depths", "opaque", "wide"])
def test_images_equal_the_twin(devices: Devices, scene: str) -> None:
    found, chosen = devices.cuda(rasterizer.render, scene=scene), SCENES[scene]()
    expected = render(parameters(chosen.gaussians), chosen.T_cw, chosen.camera)
    atol = 4.0 * T_MIN if scene in EARLY_STOP else ATOL
    assert_images_agree(found, vars(expected), decided(scene), atol)


@pytest.mark.parametrize("scene", ["ordinary", "saturated", "crowded", "needles", "wide"])
def test_gradients_equal_central_differences(devices: Devices, scene: str) -> None:
    """Of each group along the signs of its own gradient, so that nothing cancels, and along a random direction."""
    found, chosen = devices.cuda(rasterizer.render, scene=scene), SCENES[scene]()
    p = parameters(chosen.gaussians)
    twin = Derivatives(p, chosen.T_cw, chosen.camera, functional(chosen), step=1e-6)
    for name in NAMES:
        gradient = found[f"grad_{name}"]
        for direction in (np.sign(gradient), np.random.default_rng(3).normal(size=gradient.shape)):
            scale = np.linalg.norm(gradient) * np.linalg.norm(direction)
            expected = twin.along(name, direction.astype(np.float64))
            assert abs((gradient * direction).sum() - expected) < 3e-4 * scale, name
    assert relative_error(found["grad_pose"], twin.pose()) < 3e-4


@pytest.mark.parametrize("grid", GRIDS)
def test_equal_depths_go_by_index(devices: Devices, grid: Grid) -> None:
    cpu, cuda = devices.both(rasterizer.render, grid, scene="equal_depths")
    np.testing.assert_array_equal(cuda["start"], cpu["start"])
    np.testing.assert_array_equal(cuda["ids"], cpu["ids"])
    depth = SCENES["equal_depths"]().gaussians.mean[:, 2]
    ties = 0
    for first, end in zip(cuda["start"][:-1], cuda["start"][1:], strict=True):
        ids = cuda["ids"][first:end]
        np.testing.assert_array_equal(ids, ids[np.lexsort((ids, depth[ids]))])
        ties += int((np.diff(depth[ids]) == 0.0).sum())
    assert ties > 500


@pytest.mark.parametrize("grid", GRIDS)
def test_hidden_gaussians_change_neither_image_nor_gradients(devices: Devices, grid: Grid) -> None:
    """The backward pass must stop where the forward pass did, or the two describe different functions."""
    whole = devices.cuda(rasterizer.render, grid, scene="opaque")
    front = devices.cuda(rasterizer.render, grid, scene="opaque_front")
    by_depth = np.argsort(SCENES["opaque"]().gaussians.mean[:, 2])
    count = len(front["grad_mean"])
    assert functional(SCENES["opaque"]()).kept == functional(SCENES["opaque_front"]()).kept == 1.0  # the same gradient
    for name in IMAGES:
        np.testing.assert_array_equal(whole[name], front[name], err_msg=name)
    for name in (f"grad_{n}" for n in NAMES):
        assert not whole[name][by_depth[count:]].any(), name
        np.testing.assert_array_equal(whole[name][by_depth[:count]], front[name], err_msg=name)


def test_each_warp_stops_where_it_did_in_the_forward_pass(devices: Devices) -> None:
    """Although others of its block go on."""
    found, layers = devices.cuda(rasterizer.wall), rasterizer.WALL[0]
    assert (found["opacity"][:, :8] > 1.0 - T_MIN).all() and (found["opacity"][:, 14:] < 0.99).all()
    for name in (n for n in found if n.startswith("grad_")):
        assert found[name][0].any() and not found[name][layers:].any(), name


@pytest.mark.parametrize("grid", GRIDS)
def test_memory_is_reused(devices: Devices, grid: Grid) -> None:
    fresh, reused = devices.cuda(rasterizer.render, grid), devices.cuda(rasterizer.render_twice, grid)
    for name, expected in reused.items():
        np.testing.assert_allclose(fresh[name], expected, rtol=1e-6, atol=1e-6, err_msg=name)


def test_buffers_grow(devices: Devices) -> None:
    assert len(devices.cuda(rasterizer.render, scene="growing")["ids"]) > 1 << 15


def test_more_splats_in_a_tile_than_two_batches(devices: Devices) -> None:
    assert np.diff(devices.cuda(rasterizer.render, scene="crowded")["start"]).max() > 512


def test_blended_pairs_are_counted(devices: Devices) -> None:
    """In parts of 8x4 pixels; on the CPU in chunks of 4x4, which are fewer."""
    cpu, cuda = devices.both(rasterizer.render)
    assert 0.7 * cuda["pair_count"] < cpu["pair_count"] <= cuda["pair_count"]
