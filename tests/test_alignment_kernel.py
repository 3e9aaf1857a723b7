"""Normal equations of alignment against their float64 twin, and the twin's Jacobians against central differences."""

from dataclasses import astuple, replace

import numpy as np
import pytest

from tests.reference import alignment as reference
from tests.reference.image import sobel
from tgslam.device import runtime
from tgslam.geometry import se3_exp
from tgslam.kernels import alignment

T_ML = se3_exp([0.02, -0.03, 0.015, 0.02, -0.015, 0.03])
SIZES = [(24, 32), (23, 37), (4, 5), (9, 1), (1, 9)]
TEXTURE = ("grey", "gx", "gy", "gxx", "gxy", "gyy")


def settings_for(height, width, **changes):
    focal = 0.9 * width + 10.0
    camera = (focal, 1.05 * focal, 0.5 * width - 0.3, 0.5 * height - 0.8)
    return replace(reference.Settings(*camera, gain=1.1, bias=-0.04, gate_depth_boost=1.5), **changes)


def rounded(images):
    """What float32 holds, in float64: the same input to the kernel and to its twin."""
    return {name: np.float32(image).astype(float) for name, image in images.items()}


def image_pair(height, width, seed=0, holes=0.15):
    """Noisy slanted surfaces with a step; holes in both depths and among the normals; a rim; gates of 1 and below."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    depth = 2.0 + 0.01 * u - 0.006 * v + 0.3 * (u > 0.7 * width)
    grey = 0.5 + 0.2 * np.sin(0.5 * u + 0.3) * np.cos(0.4 * v)

    def noisy_depth():
        noisy = depth + 0.004 * rng.normal(size=depth.shape)
        return np.where(rng.random(depth.shape) < holes, 0.0, noisy)

    normal = np.array([0.3, -0.2, -1.0]) + 0.2 * rng.normal(size=(*depth.shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[rng.random(depth.shape) < holes] = 0.0
    live_grey, model_grey = (grey + 0.03 * rng.normal(size=grey.shape) for _ in range(2))
    live = {"depth": noisy_depth(), "grey": live_grey}
    live["gx"], live["gy"] = sobel(live_grey)
    live["gate"] = np.where(rng.random(depth.shape) < 0.3, 1.0, rng.random(depth.shape))
    live["saturated"] = np.random.default_rng(seed + 100).random(depth.shape) < 0.1
    live["gate"][live["saturated"]] = 1.0
    model = {"depth": noisy_depth(), "normal": normal, "grey": model_grey}
    model["depth"][:, -width // 4 :] *= -1.0  # the map's rim
    model["gx"], model["gy"] = sobel(model_grey)
    model["gxx"], model["gxy"] = sobel(model["gx"])
    model["gyy"] = sobel(model["gy"])[1]
    return rounded(live), rounded(model)


def in_blocks(images):
    """Images [H, W] as the kernel reads a live frame, [H, B, LIVE, 16]; lanes beyond the image hold no depth."""
    height, width = images[0].shape
    blocks = -(-width // alignment.LANES)
    records = np.zeros((height, blocks * alignment.LANES, alignment.LIVE), np.float32)
    records[:, :width] = np.stack(images, axis=-1)
    records = records.reshape(height, blocks, alignment.LANES, alignment.LIVE)
    return aligned(records.swapaxes(2, 3))


def aligned(array):
    """A copy that lanes can be loaded from."""
    copy = runtime.empty(array.shape)
    copy[:] = array
    return copy


def run_kernel(settings, T_ml, live, model):
    """The kernel's rows of sums, one for each part of the image."""
    height, width = live["depth"].shape
    values = np.zeros(alignment.SETTINGS, np.float32)
    values[: alignment.GATE_LOW] = astuple(settings)
    values[alignment.GATE_INVERSE_RANGE] = 1.0  # a gradient magnitude of 1 - T: the gate is T
    values[alignment.POSE :] = T_ml[:3].reshape(12)
    strength = np.where(live["saturated"], -1.0, 1.0 - live["gate"])
    pixels = in_blocks([live["depth"], live["grey"], live["gx"], live["gy"], strength])
    surface = aligned(np.concatenate([model["normal"], model["depth"][..., None]], axis=-1))
    unused = [np.full((height, width), np.nan)] * 2
    texture = aligned(np.stack([model[name] for name in TEXTURE] + unused, axis=-1))
    parts = alignment.parts(height)
    scratch = runtime.empty((parts, alignment.PADDED_SUMS, alignment.LANES))
    packed = runtime.empty((parts, alignment.PACKED_SUMS, alignment.LANES))
    scratch.fill(np.nan)  # every entry must be written
    packed.fill(np.nan)
    alignment.normal_equations(runtime.to_device(values), pixels, surface, texture, scratch, packed)
    rows = runtime.to_host(packed).reshape(parts, -1)
    assert not rows[:, alignment.SUMS :].any()
    assert rows[:, alignment.LIVE_PIXELS].sum() == (np.count_nonzero(live["depth"]) if min(height, width) > 3 else 0)
    return rows[:, : alignment.SUMS]


def by_name(partial):
    """The columns of the sums, as the twin names them."""
    sums = partial.sum(0, dtype=np.float64)
    A = np.zeros((6, 6))
    for a in range(6):
        for b in range(a, 6):
            A[a, b] = A[b, a] = sums[alignment.triangle(a, b)]
    return {
        "A": A,
        "b": sums[alignment.RHS : alignment.RHS + 6],
        "candidates": sums[alignment.CANDIDATES],
        "matched": sums[alignment.MATCHED],
        "inliers": sums[alignment.INLIERS],
        "depth_sum": sums[alignment.DEPTH_SUM],
        "colour_sum": sums[alignment.COLOUR_SUM],
        "shown": sums[alignment.SHOWN],
        "moments": sums[[alignment.W, alignment.W_L, alignment.W_M, alignment.W_LL, alignment.W_LM]],
    }


def assert_same(found, expected, relative=2e-5):
    for name in ("candidates", "matched", "inliers", "shown"):
        assert found[name] == expected[name], name
    for name in ("depth_sum", "colour_sum", "moments"):
        np.testing.assert_allclose(found[name], expected[name], rtol=relative, err_msg=name)
    scale = np.sqrt(np.diag(expected["A"]))  # an entry's rounding is that of the terms it sums
    np.testing.assert_allclose(found["A"], expected["A"], rtol=0, atol=relative * np.outer(scale, scale).max())
    spread = relative * scale * np.sqrt(max(expected["candidates"], 1)) * 3
    assert (abs(found["b"] - expected["b"]) <= spread).all(), "b"


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("seed", [0, 1])
def test_sums_match_the_twin(size, seed):
    settings, (live, model) = settings_for(*size), image_pair(*size, seed=seed)
    expected = reference.normal_equations(settings, T_ML, live, model)
    assert_same(by_name(run_kernel(settings, T_ML, live, model)), expected)
    if size[0] > 20:  # every kind of pixel is there
        measured = np.count_nonzero(live["depth"])
        assert 0 < expected["inliers"] < expected["matched"] < expected["candidates"] < measured


@pytest.mark.parametrize(
    "changes",
    [
        {"weight_gradient": 0.0},
        {"weight_depth": 0.0, "weight_gradient": 0.0, "weight_colour": 3.0},
        {"weight_colour": 0.0, "weight_gradient": 0.0},
        {"weight_depth": 0.0, "weight_colour": 0.0, "weight_gradient": 2.0},
        {"charbonnier_depth": 0.2, "sigma_gradient": 0.005, "sigma_colour": 0.01},
        {"max_distance_sigmas": 2.0},
        {"surface_sigma": 0.004},
        {"live_share": 0.5},
    ],
)
def test_each_setting_is_honoured(changes):
    settings, (live, model) = settings_for(23, 37, **changes), image_pair(23, 37, seed=5)
    expected = reference.normal_equations(settings, T_ML, live, model)
    plain = reference.normal_equations(settings_for(23, 37), T_ML, live, model)
    assert_same(by_name(run_kernel(settings, T_ML, live, model)), expected)
    assert abs(expected["A"] - plain["A"]).max() > 1e-3 * abs(plain["A"]).max()


@pytest.mark.parametrize("what", ["live depth", "model depth", "behind", "beside", "no match"])
def test_nothing_in_common_gives_zero(what):
    settings, (live, model) = settings_for(24, 32), image_pair(24, 32, holes=0.0)
    T_ml = T_ML.copy()
    if what == "live depth":
        live["depth"][:] = 0
    elif what == "model depth":
        model["depth"][:] = 0
    elif what == "behind":
        T_ml[2, 3] = -5.0
    elif what == "beside":
        T_ml[0, 3] = 8.0
    else:
        model["depth"] *= 3.0
    found = run_kernel(settings, T_ml, live, model)
    candidates = found[:, alignment.CANDIDATES].copy()
    found[:, [alignment.CANDIDATES, alignment.LIVE_PIXELS]] = 0
    assert not found.any()
    assert (candidates.sum() > 0) == (what == "no match")


def test_pixels_without_a_normal_count_for_colour_only():
    settings, (live, model) = settings_for(24, 32), image_pair(24, 32)
    model["normal"][:] = 0
    found = by_name(run_kernel(settings, T_ML, live, model))
    assert_same(found, reference.normal_equations(settings, T_ML, live, model))
    assert found["matched"] > 100 and found["inliers"] == found["depth_sum"] == 0 and found["colour_sum"] > 0


def test_the_normal_matrix_is_positive_semidefinite():
    settings, (live, model) = settings_for(24, 32), image_pair(24, 32)
    values = np.linalg.eigvalsh(by_name(run_kernel(settings, T_ML, live, model))["A"])
    assert values[0] > -1e-6 * values[-1] and values[-1] > 0


def test_repeats_bit_for_bit():
    height, width = 150, 41  # more rows than one thread takes
    settings, (live, model) = settings_for(height, width), image_pair(height, width)
    first = run_kernel(settings, T_ML, live, model)
    assert run_kernel(settings, T_ML, live, model).tobytes() == first.tobytes()
    assert first.any()


# Bilinear sampling is smooth only within a cell. The images below are made so that this does not show: intensity is
# quadratic in the pixel, whose gradient is affine and its second derivatives constant, which bilinear sampling and
# Sobel reproduce exactly; the intensity itself is evaluated as the polynomial.
QUADRATIC = (0.4, 0.011, -0.007, 0.0006, -0.0004, 0.0009)  # 1, u, v, uu, uv, vv


def intensity(u, v):
    c = QUADRATIC
    return c[0] + c[1] * u + c[2] * v + c[3] * u * u + c[4] * u * v + c[5] * v * v


def slopes(u, v):
    c = QUADRATIC
    return np.array([c[1] + 2 * c[3] * u + c[4] * v, c[2] + c[4] * u + 2 * c[5] * v])


def smooth_pair(height, width):
    v, u = np.mgrid[:height, :width].astype(float)
    live, model = image_pair(height, width, seed=3, holes=0.0)
    live["gate"][:], live["saturated"][:] = 0.5, 0.0
    model["grey"] = intensity(u, v)
    model["gx"], model["gy"] = slopes(u, v)
    ones = np.ones((height, width))
    model["gxx"], model["gxy"], model["gyy"] = 2 * QUADRATIC[3] * ones, QUADRATIC[4] * ones, 2 * QUADRATIC[5] * ones
    return live, model


def test_the_smooth_images_are_what_sobel_gives():
    _, model = smooth_pair(12, 15)
    inner = np.s_[1:-1, 1:-1]
    for found, name in zip((*sobel(model["grey"]), *sobel(model["gx"])), ("gx", "gy", "gxx", "gxy"), strict=True):
        np.testing.assert_allclose(found[inner], model[name][inner], atol=1e-12)


def point_residuals(s, T_ml, live, model, u, v, met):
    """Residuals of a live pixel against the model pixel `met` (u, v) and the analytic intensity; divided by nothing."""
    x = T_ml[:3] @ np.append(reference.back_project(s, u, v, live["depth"][v, u]), 1.0)
    um, vm = reference.project(s, x)
    on_model = reference.back_project(s, *met, model["depth"][met[1], met[0]])
    distance = model["normal"][met[1], met[0]] @ (x - on_model)
    colour = intensity(um, vm) - s.gain * live["grey"][v, u] - s.bias
    gradient = slopes(um, vm) - s.gain * np.array([live["gx"][v, u], live["gy"][v, u]])
    return np.array([distance, colour, *gradient])


def test_jacobians_are_the_central_differences_of_the_residuals():
    settings, (live, model) = settings_for(24, 32), smooth_pair(24, 32)
    checked, step = 0, 1e-6
    for v, u in [(5, 6), (12, 15), (17, 9), (11, 20), (8, 26), (19, 28)]:
        p = reference.pixel(settings, T_ML, live, model, u, v)
        if p is None or p.depth is None or p.colour is None:
            continue
        x = T_ML[:3] @ np.append(reference.back_project(settings, u, v, live["depth"][v, u]), 1.0)
        met = np.floor(reference.project(settings, x) + 0.5).astype(int)
        ends = [
            [
                point_residuals(settings, se3_exp(sign * step * axis) @ T_ML, live, model, u, v, met)
                for axis in np.eye(6)
            ]
            for sign in (1, -1)
        ]
        expected = (np.array(ends[0]) - np.array(ends[1])).T / (2 * step)
        here = point_residuals(settings, T_ML, live, model, u, v, met)
        per_sigma = p.depth.e[0] / here[0]
        expected *= np.array([per_sigma, 1 / settings.sigma_colour, *[1 / settings.sigma_gradient] * 2])[:, None]
        found = np.vstack([p.depth.jacobian, p.colour.jacobian, p.gradient.jacobian])
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * abs(expected).max())
        checked += 1
    assert checked >= 4


def test_b_is_the_gradient_of_the_cost():
    """The reweighted right-hand side is the slope of the robust cost along a left perturbation of T_ml."""
    settings, (live, model) = settings_for(24, 32, weight_colour=0.0), smooth_pair(24, 32)
    slopes_found = reference.normal_equations(settings, T_ML, live, model)["b"]
    kernel = by_name(run_kernel(settings, T_ML, live, model))["b"]
    step = 1e-9  # no pixel changes its partner over it
    for axis in range(6):
        xi = step * np.eye(6)[axis]
        ends = [reference.cost(settings, se3_exp(sign * xi) @ T_ML, live, model) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        assert slopes_found[axis] == pytest.approx(expected, rel=1e-3, abs=1e-3 * abs(slopes_found).max())
        assert kernel[axis] == pytest.approx(expected, rel=1e-3, abs=1e-3 * abs(slopes_found).max())
