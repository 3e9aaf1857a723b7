"""The instance field: weights, E_pgi and its gradient, relaxation, ids read back, and how fast embeddings learn."""

import numpy as np
import pytest

from tests.reference import instance_field as reference
from tests.reference.palette import ids_of
from tests.test_loss_kernels import assert_gradient, central
from tests.tiers import changed
from tgslam.bench.ablation import identity_study as identity
from tgslam.config.plane_settings import StructureConfig
from tgslam.device import runtime
from tgslam.kernels import instance_field as kernels
from tgslam.ops import instance_field
from tgslam.planes.identity import palette
from tgslam.planes.identity.codes import code_table, codes_of, read_ids

CONFIG = changed(StructureConfig(), lambda_pgi=0.7, scalar_ids=12)
FIELD = CONFIG.expert.embedding
OTHER = 2.0**-10  # a derivative by opacity that is there before
SIZES = [(48, 64), (37, 50), (9, 33)]


def scene(height=37, width=50, seed=0):
    """Ids with boundaries, some beyond the table, holes in the depth, and a rendering that differs from them."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    ids = ((u // 11 + 2 * (v // 9)) % 9 - 1).astype(np.int32)
    depth = np.where(rng.random(ids.shape) < 0.1, 0.0, 1.0 + 0.01 * u)
    codes = code_table(np.arange(6), CONFIG)  # of ids 0 to 5
    opacity = rng.uniform(0.3, 1.0, ids.shape)
    shown = codes_of(ids, CONFIG) + 0.1 * rng.normal(size=(height, width, 3))
    embedding = opacity[..., None] * np.clip(shown, 0, 1)
    return [np.float32(a).astype(float) for a in (embedding, opacity)], ids, np.float32(depth), codes


def evaluate(rendering, ids, depth, codes, config=CONFIG):
    """E_pgi's gradient, the target, and the derivative by opacity, which was added to another one."""
    target = instance_field.prepare(ids, runtime.to_device(depth), config.expert.embedding)
    g_opacity = runtime.to_device(np.full(ids.shape, OTHER))
    embedding, opacity = (runtime.to_device(image) for image in rendering)
    found = instance_field.pgi_loss(
        embedding, opacity, target, runtime.to_device(codes), config, g_opacity, instance_field.Workspace(*ids.shape)
    )
    return found, target, runtime.to_host(g_opacity) - np.float32(OTHER)


@pytest.mark.parametrize("size", SIZES)
def test_weights_match_the_twin(size):
    _, ids, depth, _ = scene(*size)
    target = instance_field.prepare(ids, runtime.to_device(depth), FIELD)
    expected = reference.weights(ids, depth, FIELD)
    np.testing.assert_allclose(runtime.to_host(target.weight), expected, rtol=1e-6)
    assert runtime.to_host(target.counted)[0] == (expected > 0).sum()


def test_weights_are_told_apart():
    ids = np.zeros((20, 30), np.int32)
    ids[:, 10:] = 1
    ids[12:, 20:] = -1
    depth = np.ones(ids.shape, np.float32)
    depth[:, 3:5] = 0
    weight = runtime.to_host(instance_field.prepare(ids, runtime.to_device(depth), FIELD).weight)
    assert weight[3, 1] == 1.0  # inside a plane, and beside a hole in the depth
    assert weight[3, 3] == 0.0
    assert weight[3, 8] == weight[3, 9] == weight[3, 10] == weight[3, 11] == 1.0 + FIELD.edge_boost
    assert weight[3, 7] == weight[3, 12] == 1.0
    assert weight[17, 27] == FIELD.no_plane_weight


@pytest.mark.parametrize("size", SIZES)
def test_values_match_the_twin(size):
    rendering, ids, depth, codes = scene(*size)
    found, target, _ = evaluate(rendering, ids, depth, codes)
    weight = runtime.to_host(target.weight).astype(float)
    expected = reference.value(*rendering, ids, weight, codes.astype(float), CONFIG)
    assert CONFIG.lambda_pgi * found.value == pytest.approx(expected, rel=1e-5)


def test_gradients_match_central_differences():
    rendering, ids, depth, codes = scene(13, 18)
    found, target, g_opacity = evaluate(rendering, ids, depth, codes)
    weight = runtime.to_host(target.weight).astype(float)
    embedding, opacity = rendering

    def value():
        return reference.value(embedding, opacity, ids, weight, codes.astype(float), CONFIG)

    assert_gradient(found.embedding, central(value, embedding, 1e-6))
    assert_gradient(g_opacity, central(value, opacity, 1e-6), relative=2e-3)


def test_the_weight_is_the_curvature_of_the_reweighted_squares():
    rendering, ids, depth, codes = scene()
    found, target, _ = evaluate(rendering, ids, depth, codes)
    wanted = codes[np.where(ids + 1 < len(codes), ids + 1, 0)]
    residual = rendering[0] - rendering[1][..., None] * wanted
    product = runtime.to_host(found.weight)[..., None] * residual
    np.testing.assert_allclose(runtime.to_host(found.embedding), product, rtol=1e-3, atol=1e-9)
    assert not runtime.to_host(found.weight)[runtime.to_host(target.weight) == 0].any()


def test_right_embeddings_ask_for_nothing_however_little_is_covered():
    (_, opacity), ids, depth, codes = scene()
    right = opacity[..., None] * codes[np.where(ids + 1 < len(codes), ids + 1, 0)]
    found, _, g_opacity = evaluate([right, opacity], ids, depth, codes)
    assert abs(runtime.to_host(found.embedding)).max() < 1e-8
    assert abs(g_opacity).max() < 1e-7
    assert found.value < 1e-6


def test_no_depth_gives_zero_not_nan():
    rendering, ids, depth, codes = scene()
    found, _, g_opacity = evaluate(rendering, ids, 0 * depth, codes)
    assert found.value == 0.0
    assert not runtime.to_host(found.embedding).any() and not runtime.to_host(found.weight).any()
    assert not g_opacity.any()


def test_relaxation_matches_the_twin():
    rng = np.random.default_rng(0)
    n = 200
    visible = rng.integers(0, 3, n)
    gradient, theta = 0.02 * rng.normal(size=(n, 3)), 3 * rng.normal(size=(n, 3))
    curvature = 10.0 ** rng.uniform(-4, 0, (n, 2))
    curvature[::7, 1] = 0.0
    most_px = 10.0 ** rng.uniform(-1, 2, n)
    moved = runtime.to_device(theta.copy())
    kernels.relax_embeddings(
        n, runtime.to_device(visible, np.int32), runtime.to_device(gradient), runtime.to_device(curvature),
        runtime.to_device([50.0]), runtime.to_device(most_px), 0.8, 0.3, 0.5, moved,
    )  # fmt: skip
    expected = reference.relax(visible > 0, gradient, curvature[:, 1], 50.0, most_px, 0.8, 0.3, 0.5, theta)
    np.testing.assert_allclose(runtime.to_host(moved), expected, atol=2e-4)
    rests = (visible == 0) | (curvature[:, 1] == 0)
    np.testing.assert_array_equal(runtime.to_host(moved)[rests], np.float32(theta)[rests])


def looked_at(theta, covered_px, plane_id, most_px, config):
    """The embedding after a view of 400 pixels, in which a Gaussian is that plane's in all the pixels it covers."""
    colour = 1 / (1 + np.exp(-theta))
    ids = np.full((20, 20), plane_id, np.int32)
    codes = code_table(np.arange(8), config)
    embedding = codes[ids + 1].astype(float)
    embedding.reshape(-1, 3)[:covered_px] = colour
    found, target, _ = evaluate([embedding, np.ones(ids.shape)], ids, np.ones(ids.shape, np.float32), codes, config)
    gradient = runtime.to_host(found.embedding).reshape(-1, 3)[:covered_px].sum(axis=0) * colour * (1 - colour)
    weight = runtime.to_host(found.weight).ravel()[:covered_px].sum()
    moved = runtime.to_device(theta[None])
    instance_field.relax(
        1, runtime.to_device([1], np.int32), runtime.to_device(gradient[None]), runtime.to_device([[0.0, weight]]),
        runtime.to_device([most_px]), target, config, moved,
    )  # fmt: skip
    return runtime.to_host(moved)[0].astype(float)


@pytest.mark.parametrize(("fringe_share", "expected"), [(FIELD.fringe_share, 3), (0.0, 7)])
def test_views_of_a_fringe_do_not_overwrite_what_a_good_view_has_told(fringe_share, expected):
    config = changed(CONFIG, fringe_share=fringe_share)

    def shown(theta):
        return ids_of(1 / (1 + np.exp(-theta[None])), np.arange(8), CONFIG.expert.reading.read_margin)[0]

    theta = instance_field.theta_of(codes_of([3], config))[0].astype(float)
    for _ in range(10):
        theta = looked_at(theta, 3, 7, 100.0, config)
    assert shown(theta) == expected
    for _ in range(3):  # a view as good as the best one is believed
        theta = looked_at(theta, 100, 5, 100.0, config)
    assert shown(theta) == 5


def test_embeddings_of_new_gaussians_show_their_code():
    colours = palette.colours([0, 5, -1])
    shown = 1 / (1 + np.exp(-instance_field.theta_of(colours).astype(float)))
    np.testing.assert_allclose(shown, np.clip(colours, kernels.LOW, kernels.HIGH), atol=1e-6)


@pytest.mark.parametrize("margin", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("known", [40, 3, 0])
def test_ids_are_read_as_by_the_twin(margin, known):
    rng = np.random.default_rng(known)
    height, width = 31, 70
    truth = np.sort(rng.integers(-1, max(known, 1), (height, width)), axis=1)
    colour = np.clip(palette.colours(truth) + 0.1 * rng.normal(size=(height, width, 3)), 0, 1)
    opacity = np.float32(rng.uniform(0.2, 1.0, (height, width)))
    embedding = np.float32(opacity[..., None] * colour)
    config = changed(CONFIG, read_margin=margin)
    found = read_ids(runtime.to_device(embedding), runtime.to_device(opacity), np.arange(known), config)
    ids = np.arange(-1, known)
    expected = reference.read(
        embedding.astype(float), opacity.astype(float), ids, palette.colours(ids).astype(float), margin, 0.5
    )
    assert (found != expected).mean() < 1e-3  # rounding, where two codes are as far
    assert (found >= 0).any() == (known > 0)
    if known:
        rows = ids_of((embedding / opacity[..., None])[opacity >= 0.5], np.arange(known), margin)
        assert (found[opacity >= 0.5] != rows).mean() < 1e-3


def test_scalar_ids_are_rounded():
    config = changed(CONFIG, identity="scalar", read_margin=0.0)
    ids = np.arange(-1, config.expert.embedding.scalar_ids)
    steps = np.array([-0.4, 0.0, 0.4])
    truth = np.repeat(ids, len(steps)).reshape(1, -1)
    first = np.interp(truth + np.tile(steps, len(ids)), ids, codes_of(ids, config)[:, 0])
    opacity = np.full(truth.shape, 0.8)
    embedding = 0.8 * np.stack([first, *np.full((2, *truth.shape), 0.5)], axis=-1)
    found = read_ids(
        runtime.to_device(embedding), runtime.to_device(opacity), np.arange(config.expert.embedding.scalar_ids), config
    )
    np.testing.assert_array_equal(found, truth)
    assert (codes_of(ids, config)[:, 1:] == 0.5).all()


def test_colours_learn_planes_faster_and_better_than_scalars():
    found = identity.measure("room", 0, (160, 120))
    colour, scalar = (curve.wrong for curve in found.curves)
    at = identity.ITERATIONS.index
    assert colour[0] > 0.9 and scalar[0] > 0.9  # neutral
    assert colour[at(1)] < 0.5 * scalar[at(1)]
    assert colour[at(40)] < 0.7 * scalar[at(40)]
    assert colour[at(5)] < 0.2 and colour[at(40)] <= colour[at(5)]
    assert identity.picture(found).shape == (240, 800, 3)
