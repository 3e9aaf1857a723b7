"""The fused objective against its float64 twin and central differences of it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.reference import image as reference_image
from tests.reference import loss as reference
from tests.tiers import changed
from tgslam.config.map_settings import LossConfig
from tgslam.device import runtime
from tgslam.ops import loss as losses

GAIN, BIAS = 1.07, -0.03
CONFIG = LossConfig(weight_geo=0.1, weight_ssim=0.7, weight_grad=2.0)
PARTS = ("l1", "grad", "ssim", "geo")


def scene(height, width, seed=0, *, masked=True):
    """A textured observation with holes and a rendering that differs from it; float64, but exact in float32."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    base = 0.5 + 0.2 * np.sin(0.6 * u + 0.2 * v) + 0.1 * (u > width // 2)
    colour_gt = np.clip(base[..., None] + 0.05 * rng.normal(size=(height, width, 3)), 0, 1)
    colour = np.clip(colour_gt + 0.08 * rng.normal(size=colour_gt.shape), 0, 1)
    depth_gt = 1.5 + 0.01 * u + 0.002 * v
    opacity = rng.uniform(0.55, 1.0, (height, width))
    if masked:
        depth_gt[rng.random(depth_gt.shape) < 0.2] = 0
        opacity[rng.random(depth_gt.shape) < 0.2] = 0.3
        opacity[2:5, 3:7] = 0
    depth = opacity * (1.5 + 0.01 * u + 0.002 * v + 0.005 * rng.normal(size=depth_gt.shape))
    mask = np.where(rng.random(depth_gt.shape) < 0.15, 0.0, rng.uniform(0.5, 1, depth_gt.shape)) if masked else base**0
    rounded = [np.float32(a).astype(float) for a in (colour, depth, opacity, colour_gt, depth_gt, mask)]
    return rounded[:3], rounded[3:]


def evaluate(rendering, observed, config=CONFIG, gain=GAIN, bias=BIAS, min_opacity=0.0, workspace=None):
    """The kernels' result, and the observation in float64 for the twin (with the kernels' gate)."""
    colour_gt, depth_gt, mask = (runtime.to_device(a) for a in observed)
    observation = losses.observe(colour_gt, depth_gt, config, mask)
    device = [runtime.to_device(a) for a in rendering]
    result = losses.rgbd_loss(*device, observation, config, gain, bias, min_opacity, workspace)
    gate = runtime.to_host(observation.gate).astype(float)
    return result, {"colour": observed[0], "depth": observed[1], "mask": observed[2], "gate": gate}


def central(function, array, step):
    """Derivative of a scalar function by every element of an array."""
    out = np.empty(array.shape)
    for at in np.ndindex(array.shape):
        kept = array[at]
        array[at] = kept + step
        above = function()
        array[at] = kept - step
        out[at] = (above - function()) / (2 * step)
        array[at] = kept
    return out


def assert_gradient(found, expected, relative=1e-3):
    found = runtime.to_host(found)
    assert np.linalg.norm(found - expected) <= relative * np.linalg.norm(expected)
    np.testing.assert_allclose(found, expected, rtol=relative, atol=relative * abs(expected).max())


@pytest.mark.parametrize("size", [(48, 64), (37, 50), (23, 17), (12, 129)])
@pytest.mark.parametrize("masked", [False, True])
def test_values_match_the_twin(size, masked):
    rendering, observed = scene(*size, masked=masked)
    result, gt = evaluate(rendering, observed, min_opacity=0.4 if masked else 0.0)
    expected = reference.parts(*rendering, gt, GAIN, BIAS, CONFIG, 0.4 if masked else 0.0)
    for part in PARTS:
        assert result.parts[part] == pytest.approx(expected[part], rel=1e-4), part
    assert result.value == pytest.approx(
        reference.value(*rendering, gt, GAIN, BIAS, CONFIG, 0.4 if masked else 0.0), rel=1e-4
    )


@pytest.mark.parametrize("term", ["l1", "grad", "ssim", "geo", "all"])
def test_gradients_match_central_differences(term):
    weights = {f"weight_{part}": 1.0 if term == part else 0.0 for part in PARTS}
    config = CONFIG if term == "all" else replace(CONFIG, **weights)
    rendering, observed = scene(15, 18, seed=3)
    result, gt = evaluate(rendering, observed, config, min_opacity=0.4)
    colour, depth, opacity = rendering

    def value():
        return reference.value(colour, depth, opacity, gt, GAIN, BIAS, config, 0.4)

    assert_gradient(result.g_colour, central(value, colour, 1e-5))
    if term in ("geo", "all"):
        assert_gradient(result.g_depth, central(value, depth, 1e-6))
        assert_gradient(result.g_opacity, central(value, opacity, 1e-6))
    step = 1e-6
    for found, change in ((result.g_gain, (step, 0)), (result.g_bias, (0, step))):
        ends = [
            reference.value(*rendering, gt, GAIN + sign * change[0], BIAS + sign * change[1], config, 0.4)
            for sign in (1, -1)
        ]
        assert found == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-3, abs=1e-7)


@pytest.mark.parametrize("size", [(61, 90), (33, 200)])
def test_directional_derivatives_across_lane_blocks(size):
    rendering, observed = scene(*size, seed=7)
    result, gt = evaluate(rendering, observed, min_opacity=0.4)
    found = [runtime.to_host(g) for g in (result.g_colour, result.g_depth, result.g_opacity)]
    for seed in range(4):
        rng = np.random.default_rng(seed)
        ways = [rng.normal(size=a.shape) for a in rendering]
        step = 1e-6
        ends = [
            reference.value(*(a + s * w for a, w in zip(rendering, ways, strict=True)), gt, GAIN, BIAS, CONFIG, 0.4)
            for s in (step, -step)
        ]
        expected = (ends[0] - ends[1]) / (2 * step)
        scale = np.sqrt(sum((g**2).sum() for g in found))
        assert abs(sum((g * w).sum() for g, w in zip(found, ways, strict=True)) - expected) <= 1e-3 * scale


def test_a_perfect_rendering_has_neither_loss_nor_gradient():
    (_, _, _), observed = scene(40, 56, masked=False)
    colour, depth, _ = observed
    result, _ = evaluate([colour, depth, np.ones_like(depth)], observed, gain=1.0, bias=0.0)
    assert all(abs(result.parts[part]) < 1e-5 for part in PARTS)
    for gradient in (result.g_colour, result.g_depth, result.g_opacity):
        assert abs(runtime.to_host(gradient)).max() < 1e-6
    assert result.parts["pixels"] == result.parts["depths"] == 40 * 56


def test_no_depth_and_no_opacity_give_zero_not_nan():
    (colour, depth, opacity), (colour_gt, depth_gt, mask) = scene(24, 33)
    holes, _ = evaluate([colour, depth, opacity], [colour_gt, 0 * depth_gt, mask])
    assert holes.parts["geo"] == 0 and holes.parts["depths"] == 0
    empty, _ = evaluate([0 * colour, 0 * depth, 0 * opacity], [colour_gt, depth_gt, mask], min_opacity=0.5)
    assert empty.value == 0 and empty.parts["pixels"] == 0
    for result in (holes, empty):
        assert not runtime.to_host(result.g_depth).any() and not runtime.to_host(result.g_opacity).any()
        assert np.isfinite(runtime.to_host(result.g_colour)).all()
    assert not runtime.to_host(empty.g_colour).any() and empty.g_gain == empty.g_bias == 0


def test_a_blank_wall_leaves_only_intensity_and_depth():
    flat = np.full((32, 48, 3), 0.5)
    depth = np.full((32, 48), 2.0)
    ones = np.ones_like(depth)
    result, gt = evaluate([flat + 0.1, depth, ones], [flat, depth, ones], gain=1.0, bias=0.0)
    assert (gt["gate"] == 1).all()
    assert result.parts["grad"] == result.parts["ssim"] == 0
    assert result.parts["l1"] == pytest.approx(np.hypot(0.1, 0.02) - 0.02, rel=1e-4)


def test_images_smaller_than_the_window_have_no_structure_terms():
    rendering, observed = scene(9, 14)
    result, _ = evaluate(rendering, observed)
    assert result.parts["grad"] == result.parts["ssim"] == 0 and result.parts["l1"] > 0
    assert np.isfinite(runtime.to_host(result.g_colour)).all()


def test_the_value_does_not_depend_on_resolution():
    rendering, observed = scene(60, 70, masked=False)
    one, _ = evaluate(rendering, observed)
    two, _ = evaluate(
        [np.tile(a, (2, 2, 1)[: a.ndim]) for a in rendering], [np.tile(a, (2, 2, 1)[: a.ndim]) for a in observed]
    )
    assert two.parts["l1"] == pytest.approx(one.parts["l1"], rel=1e-5)
    assert two.parts["geo"] == pytest.approx(one.parts["geo"], rel=1e-1)
    assert two.parts["ssim"] == pytest.approx(one.parts["ssim"], rel=1e-1)


def test_repeats_bit_for_bit_and_with_a_used_workspace():
    rendering, observed = scene(45, 70)
    workspace = losses.Workspace(45, 70)
    other, other_observed = scene(45, 70, seed=9)
    evaluate(other, other_observed, workspace=workspace)
    again, _ = evaluate(rendering, observed, workspace=workspace)
    fresh, _ = evaluate(rendering, observed)
    assert again.value == fresh.value and again.g_gain == fresh.g_gain
    for name in ("g_colour", "g_depth", "g_opacity", "w_colour", "w_depth"):
        np.testing.assert_array_equal(runtime.to_host(getattr(again, name)), runtime.to_host(getattr(fresh, name)))


def test_numbers_that_were_read_outlive_the_workspace():
    rendering, observed = scene(33, 48)
    workspace = losses.Workspace(33, 48)
    first, _ = evaluate(rendering, observed, workspace=workspace)
    before = first.value, first.g_gain, first.g_bias
    other, _ = evaluate(scene(33, 48, seed=5)[0], observed, workspace=workspace)
    assert (first.value, first.g_gain, first.g_bias) == before
    assert other.value != first.value and other.g_gain != first.g_gain


def test_images_anywhere_in_memory_give_the_same():
    """Kernels load whole vectors, in place where an image begins at a multiple of 64 bytes."""
    rendering, observed = scene(33, 48)
    found, _ = evaluate([at_offset(a, 0) for a in rendering], [at_offset(a, 0) for a in observed])
    moved, _ = evaluate([at_offset(a, 4) for a in rendering], [at_offset(a, 4) for a in observed])
    assert moved.value == found.value
    for name in ("g_colour", "g_depth", "g_opacity", "w_colour", "w_depth"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(found, name))


def at_offset(image, offset_bytes):
    """A float32 copy that begins at a multiple of 64 bytes plus an offset."""
    memory = runtime.empty((image.size + 16,)).view(np.uint8)
    copy = memory[offset_bytes : offset_bytes + 4 * image.size].view(np.float32).reshape(image.shape)
    copy[:] = image
    return copy


def test_the_gate_moves_weight_from_colour_to_depth():
    rendering, observed = scene(40, 48, masked=False)
    plain = changed(CONFIG, gate_depth_boost=0.0)
    gated, gt = evaluate(rendering, observed)
    ungated, _ = evaluate(rendering, observed, plain)
    ratio = runtime.to_host(gated.g_depth) / runtime.to_host(ungated.g_depth)
    np.testing.assert_allclose(ratio, 1 + gt["gate"], rtol=1e-4)
    np.testing.assert_allclose(
        gt["gate"], reference_image.texture_gate(reference_image.luminance(observed[0]), 95, 0.01), atol=1e-4
    )


def test_without_the_gate_no_term_asks_for_texture():
    rendering, observed = scene(40, 48, masked=False)
    ungated, gt = evaluate(rendering, observed, replace(CONFIG, gate=False))
    assert not gt["gate"].any()
    plain, _ = evaluate(rendering, observed, changed(CONFIG, gate=False, gate_depth_boost=0.0))
    np.testing.assert_array_equal(runtime.to_host(ungated.g_depth), runtime.to_host(plain.g_depth))
    gated, _ = evaluate(rendering, observed)
    assert ungated.parts["ssim"] > gated.parts["ssim"], "texture and all else count alike"
    assert ungated.parts["grad"] > gated.parts["grad"]


def test_curvatures_are_those_of_reweighted_least_squares():
    (_, depth, opacity), (colour_gt, depth_gt, mask) = scene(30, 41)
    offset = np.float32(np.random.default_rng(2).normal(size=depth.shape) * 0.1)
    colour = np.float32(colour_gt + offset[..., None])  # the same residual in all channels
    config = replace(CONFIG, weight_grad=0.0, weight_ssim=0.0)
    result, _ = evaluate([colour, depth, opacity], [colour_gt, depth_gt, mask], config, gain=1.0, bias=0.0)
    expected = runtime.to_host(result.w_colour)[..., None] * (colour - colour_gt)
    np.testing.assert_allclose(runtime.to_host(result.g_colour), expected, rtol=1e-4, atol=1e-9)
    expected = runtime.to_host(result.w_depth) * (depth - opacity * depth_gt)
    scale = abs(runtime.to_host(result.g_depth)).max()
    np.testing.assert_allclose(runtime.to_host(result.g_depth), expected, rtol=1e-3, atol=1e-4 * scale)
    brighter, _ = evaluate([colour / 1.5, depth, opacity], [colour_gt, depth_gt, mask], config, gain=1.5, bias=0.0)
    ratio = runtime.to_host(brighter.w_colour)[mask > 0] / runtime.to_host(result.w_colour)[mask > 0]
    np.testing.assert_allclose(ratio, 1.5**2, rtol=1e-3)


def test_wrong_arrays_are_named():
    rendering, observed = scene(20, 24)
    colour, depth, opacity = (runtime.to_device(a) for a in rendering)
    observation = losses.observe(*(runtime.to_device(a) for a in observed[:2]), CONFIG)
    with pytest.raises(ValueError, match="depth must have shape"):
        losses.rgbd_loss(colour, opacity[:-1], opacity, observation, CONFIG)
    with pytest.raises(ValueError, match="opacity must be float32"):
        losses.rgbd_loss(colour, depth, opacity.astype(float), observation, CONFIG)
    with pytest.raises(ValueError, match="workspace"):
        losses.rgbd_loss(colour, depth, opacity, observation, CONFIG, workspace=losses.Workspace(24, 20))
