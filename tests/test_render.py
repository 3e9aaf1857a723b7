"""The rasterizer against its float64 twin: images, gradients by central differences, and the hard cases, each forced.

Images agree to 2e-4: the kernels finish a 4x4 chunk when all of it lets less than T_MIN = 1e-4 through, `exp_neg` is
good to 2.6e-6, and the rest is float32. Pixels where an alpha lies within BAND of the threshold (or of the cap, where
the gradient jumps) are left out, since rounding decides there; there are few, and a test counts them.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.reference.projection import NAMES, Parameters, parameters, project
from tests.reference.rasterize import Derivatives, Images, decisions_at, render, undecided
from tgslam.camera import Camera
from tgslam.geometry import se3_exp
from tgslam.kernels.projection import BLUR
from tgslam.kernels.simd import ALPHA_MIN, T_MIN
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.rasterize import ImageGradient, Rasterizer
from tgslam.ops.render_images import MIN_OPACITY
from tgslam.ops.splats import MapGradient
from tgslam.types import Gaussians

BAND = 1e-4  # relative; float32 offsets of some 50 px leave errors of up to 1e-5 in alpha
ATOL = 2e-4
CAMERA = Camera(width=50, height=37, fx=45.0, fy=48.0, cx=24.3, cy=18.9)
TILE_CAMERA = Camera(width=16, height=16, fx=20.0, fy=21.0, cx=7.4, cy=7.7)
# A rotated, moved camera, rounded to what the kernels can hold, so that both sides see the same numbers
POSE = se3_exp([0.11, -0.07, 0.2, 0.15, -0.1, 0.3]).astype(np.float32).astype(np.float64)


def make_gaussians(**fields: np.ndarray) -> Gaussians:
    """Gaussians with the given fields and plain defaults for the others."""
    n = len(fields["mean"])
    defaults = {
        "log_scale": np.full((n, 3), np.log(0.1)),
        "quat_wxyz": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        "opacity_logit": np.zeros(n),
        "colour": np.full((n, 3), 0.5),
        "embedding": np.zeros((n, 3)),
    }
    floats = {name: np.asarray(values, np.float32) for name, values in (defaults | fields).items()}
    return Gaussians(**floats, plane_id=np.full(n, -1, np.int32), birth_keyframe=np.zeros(n, np.int32))


def random_gaussians(
    n: int,
    camera: Camera,
    seed: int = 0,
    *,
    tangent: float = 1.0,
    scale_m: tuple[float, float] = (0.03, 0.25),
    logit: tuple[float, float] = (-2.0, 1.5),
    T_cw: np.ndarray = POSE,
) -> Gaussians:
    """Gaussians 1 to 4 m before the camera, in directions up to `tangent` times the image's edges."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(1.0, 4.0, n)
    half = [0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy]
    points_c = np.column_stack([rng.uniform(-tangent, tangent, (n, 2)) * half, np.ones(n)]) * z[:, None]
    return make_gaussians(
        mean=(points_c - T_cw[:3, 3]) @ T_cw[:3, :3],
        log_scale=rng.uniform(*np.log(scale_m), (n, 3)),
        quat_wxyz=rng.normal(size=(n, 4)),  # of any length: the kernels normalise
        opacity_logit=rng.uniform(*logit, n),
        colour=rng.uniform(0.0, 1.0, (n, 3)),
        embedding=rng.normal(size=(n, 3)),
    )


class Functional:
    """A random linear functional of all four outputs; zero at the pixels that rounding decides."""

    def __init__(self, p: Parameters, T_cw: np.ndarray, camera: Camera, seed: int = 1, band: float = BAND) -> None:
        rng = np.random.default_rng(seed)
        H, W = camera.height, camera.width
        keep = ~undecided(p, T_cw, camera, band)
        self.kept = float(keep.mean())
        self.colour = np.float32(rng.normal(size=(H, W, 3)) * keep[..., None])
        self.depth = np.float32(rng.normal(size=(H, W)) * keep)
        self.opacity = np.float32(rng.normal(size=(H, W)) * keep)
        self.embedding = np.float32(rng.normal(size=(H, W, 3)) * keep[..., None])

    def __call__(self, images: Images) -> float:
        return float(
            (self.colour * images.colour).sum()
            + (self.depth * images.depth).sum()
            + (self.opacity * images.opacity).sum()
            + (self.embedding * images.embedding).sum()
        )

    def image_gradient(self) -> ImageGradient:
        """As `backward` takes it."""
        return ImageGradient(self.colour, self.depth, self.opacity, self.embedding)


def kernel_gradients(
    gaussians: Gaussians, T_cw: np.ndarray, camera: Camera, gradient: ImageGradient
) -> dict[str, np.ndarray]:
    """Gradients of the kernels by parameter, and `pose` and `curvature`."""
    gaussian_map = GaussianMap.from_gaussians(gaussians)
    rasterizer, into = Rasterizer(camera), MapGradient.zeros(gaussian_map.capacity)
    rasterizer.forward(gaussian_map, T_cw, with_embedding=True)
    pose = rasterizer.backward(gaussian_map, gradient, into)
    n = gaussian_map.count
    return {name: getattr(into, name)[:n].copy() for name in (*NAMES, "curvature")} | {"pose": pose}


def assert_images_match(
    gaussians: Gaussians, T_cw: np.ndarray, camera: Camera, atol: float = ATOL, most_left_out: float = 0.03
) -> Images:
    """All four outputs equal the twin's; returns the twin's."""
    p = parameters(gaussians)
    expected = render(p, T_cw, camera)
    images = Rasterizer(camera).forward(GaussianMap.from_gaussians(gaussians), T_cw, with_embedding=True)
    keep = ~undecided(p, T_cw, camera, BAND)
    assert keep.mean() >= 1.0 - most_left_out
    for name in ("colour", "depth", "opacity", "embedding"):
        actual, wanted = getattr(images, name), getattr(expected, name)
        assert np.isfinite(actual).all()
        np.testing.assert_allclose(actual[keep], wanted[keep], rtol=0.0, atol=atol, err_msg=name)
    return expected


def relative_error(actual: np.ndarray, expected: np.ndarray) -> float:
    """Norm of the difference over the norm of `expected`."""
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


def assert_gradient_matches(actual: np.ndarray, expected: np.ndarray, name: str, rtol: float = 2e-4) -> None:
    """Norm-wise, element by element where an element is not small, and nothing silently zero."""
    assert np.isfinite(actual).all(), name
    error = relative_error(actual, expected)
    print(f"{name}: relative error {error:.1e}")
    assert error < rtol, f"{name}: relative error {error:.2e}"
    largest = np.abs(expected).max()
    large = np.abs(expected) > 0.01 * largest
    np.testing.assert_allclose(actual[large], expected[large], rtol=10 * rtol, err_msg=name)
    assert (actual[np.abs(expected) > 1e-4 * largest] != 0).all(), f"{name}: zero where the twin is not"
    assert (np.abs(actual[expected == 0]) < 1e-6 * largest).all(), f"{name}: non-zero where the twin is zero"


def check_gradients(
    gaussians: Gaussians,
    T_cw: np.ndarray,
    camera: Camera,
    rows: list[int] | None = None,
    rtol: float = 2e-4,
    names: tuple[str, ...] = (*NAMES, "pose"),
) -> dict[str, np.ndarray]:
    """Every parameter group of `rows` (default all) against central differences; returns the kernels' gradients."""
    p = parameters(gaussians)
    loss = Functional(p, T_cw, camera)
    assert loss.kept > 0.9
    actual = kernel_gradients(gaussians, T_cw, camera, loss.image_gradient())
    twin = Derivatives(p, T_cw, camera, loss)
    rows = list(range(len(gaussians))) if rows is None else rows
    for name in names:
        if name == "pose":
            assert_gradient_matches(actual[name], twin.pose(), name, rtol)
        else:
            assert_gradient_matches(actual[name][rows], twin.parameter(name, rows), name, rtol)
    return actual


def check_directions(gaussians: Gaussians, T_cw: np.ndarray, camera: Camera, rtol: float = 2e-4) -> None:
    """Directional derivatives of each whole group, for scenes where element by element would take minutes.

    The direction is the sign pattern of the kernel's own gradient: nothing cancels, and the error is that of sum |g|.
    """
    p = parameters(gaussians)
    loss = Functional(p, T_cw, camera)
    actual = kernel_gradients(gaussians, T_cw, camera, loss.image_gradient())
    twin = Derivatives(p, T_cw, camera, loss, step=1e-6)
    for name in NAMES:
        for direction in (np.sign(actual[name]), np.random.default_rng(3).normal(size=p[name].shape)):
            scale = np.linalg.norm(actual[name]) * np.linalg.norm(direction)
            expected = twin.along(name, direction.astype(np.float64))
            assert abs((actual[name] * direction).sum() - expected) < rtol * scale, name
    assert_gradient_matches(actual["pose"], twin.pose(), "pose", rtol)


# Forward and backward on ordinary scenes


@pytest.mark.parametrize("seed", range(3))
def test_images_equal_the_twin(seed: int) -> None:
    gaussians = random_gaussians(80, CAMERA, seed)
    expected = assert_images_match(gaussians, POSE, CAMERA)
    assert 0.2 < expected.opacity.mean() < 0.999


def test_gradients_equal_central_differences() -> None:
    gaussians = random_gaussians(40, CAMERA, seed=5)
    check_gradients(gaussians, POSE, CAMERA)


def test_gradients_of_each_output_alone() -> None:
    """A functional of all outputs could hide an error in the small ones."""
    gaussians = random_gaussians(25, CAMERA, seed=6)
    p = parameters(gaussians)
    for name in ("colour", "depth", "opacity", "embedding"):
        loss = Functional(p, POSE, CAMERA)
        for other in {"colour", "depth", "opacity", "embedding"} - {name}:
            getattr(loss, other)[:] = 0.0
        actual = kernel_gradients(gaussians, POSE, CAMERA, loss.image_gradient())
        twin = Derivatives(p, POSE, CAMERA, loss)
        assert relative_error(actual["pose"], twin.pose()) < 1e-3
        for parameter in ("mean", "log_scale", "quat_wxyz", "opacity_logit"):
            expected = twin.parameter(parameter, [0, 7, 12, 20])
            assert relative_error(actual[parameter][[0, 7, 12, 20]], expected) < 1e-3, (name, parameter)


def test_gradients_without_embedding_are_those_of_the_other_outputs() -> None:
    gaussians = random_gaussians(30, CAMERA, seed=7)
    loss = Functional(parameters(gaussians), POSE, CAMERA)
    loss.embedding[:] = 0.0
    with_zero = kernel_gradients(gaussians, POSE, CAMERA, loss.image_gradient())
    gradient = loss.image_gradient()
    gradient.embedding = None
    without = kernel_gradients(gaussians, POSE, CAMERA, gradient)
    assert not without["embedding"].any()
    for name in (*NAMES, "pose"):
        np.testing.assert_allclose(without[name], with_zero[name], rtol=1e-4, atol=1e-4, err_msg=name)


def test_an_embedding_gradient_needs_the_embedding() -> None:
    gaussian_map = GaussianMap.from_gaussians(random_gaussians(3, CAMERA))
    rasterizer = Rasterizer(CAMERA)
    rasterizer.forward(gaussian_map, POSE)
    gradient = Functional(parameters(gaussian_map.gaussians()), POSE, CAMERA).image_gradient()
    with pytest.raises(ValueError, match="with_embedding"):
        rasterizer.backward(gaussian_map, gradient, MapGradient.zeros(gaussian_map.capacity))


@pytest.mark.parametrize("pose", [np.eye(3), np.full((4, 4), np.nan), np.zeros((3, 4))])
def test_a_bad_pose_is_refused(pose: np.ndarray) -> None:
    with pytest.raises(ValueError, match="T_cw"):
        Rasterizer(CAMERA).forward(GaussianMap(4), pose)


def test_backward_adds_to_what_is_there() -> None:
    gaussians = random_gaussians(20, CAMERA, seed=8)
    gaussian_map, rasterizer = GaussianMap.from_gaussians(gaussians), Rasterizer(CAMERA)
    gradient = Functional(parameters(gaussians), POSE, CAMERA).image_gradient()
    into = MapGradient.zeros(gaussian_map.capacity)
    rasterizer.forward(gaussian_map, POSE, with_embedding=True)
    first = rasterizer.backward(gaussian_map, gradient, into)
    once = into.mean.copy()
    second = rasterizer.backward(gaussian_map, gradient, into)
    np.testing.assert_array_equal(first, second)  # the pose's is returned, not added up
    # The compiler may add what is there before or after the last product: equal up to the rounding of one sum
    np.testing.assert_allclose(into.mean, 2.0 * once, rtol=1e-6, atol=1e-6 * np.abs(once).max())


def test_curvature_is_the_weighted_sum_of_blend_weights() -> None:
    gaussians = random_gaussians(60, CAMERA, seed=9)
    p = parameters(gaussians)
    loss = Functional(p, POSE, CAMERA)
    rng = np.random.default_rng(10)
    keep = ~undecided(p, POSE, CAMERA, BAND)
    gradient = loss.image_gradient()
    gradient.colour_weight = np.float32(rng.uniform(0.0, 1.0, keep.shape) * keep)
    gradient.depth_weight = np.float32(rng.uniform(0.0, 50.0, keep.shape) * keep)
    actual = kernel_gradients(gaussians, POSE, CAMERA, gradient)["curvature"]
    weight = render(p, POSE, CAMERA).weight
    for column, image in enumerate((gradient.colour_weight, gradient.depth_weight)):
        expected = (weight * image).sum((1, 2))
        np.testing.assert_allclose(actual[:, column], expected, rtol=1e-4, atol=1e-4 * expected.max())


def test_render_divides_depth_by_opacity() -> None:
    gaussians = random_gaussians(60, CAMERA, seed=11)
    rendering = Rasterizer(CAMERA).render(gaussians, POSE)
    images = Rasterizer(CAMERA).forward(GaussianMap.from_gaussians(gaussians), POSE)
    solid = rendering.opacity >= MIN_OPACITY
    assert solid.any() and not solid.all()
    np.testing.assert_allclose(rendering.depth_m[solid], images.depth[solid] / images.opacity[solid], rtol=1e-6)
    assert not rendering.depth_m[~solid].any()


# Image sizes and empty places


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (15, 1), (16, 16), (17, 33), (32, 16), (3, 5)])
def test_any_image_size(width: int, height: int) -> None:
    camera = Camera(width, height, 30.0, 31.0, 0.5 * width - 0.7, 0.5 * height - 0.2)
    gaussians = random_gaussians(15, camera, seed=width, tangent=1.5)
    assert_images_match(gaussians, POSE, camera, most_left_out=0.0 if width == height == 1 else 0.05)
    check_directions(gaussians, POSE, camera)


def test_tiles_that_nothing_touches_stay_black() -> None:
    camera = Camera(64, 64, 60.0, 60.0, 31.5, 31.5)
    mean = np.array([[-0.4, -0.4, 1.0], [-0.42, -0.38, 1.2]])
    gaussians = make_gaussians(mean=mean, log_scale=np.full((2, 3), np.log(0.03)), opacity_logit=[2.0, 1.0])
    expected = assert_images_match(gaussians, np.eye(4), camera)
    assert expected.opacity.max() > 0.5 and not expected.opacity[32:, 32:].any()
    images = Rasterizer(camera).forward(GaussianMap.from_gaussians(gaussians), np.eye(4), with_embedding=True)
    for image in (images.colour, images.depth, images.opacity, images.embedding):
        assert not image[32:, 32:].any()
    check_gradients(gaussians, np.eye(4), camera, names=("mean", "log_scale", "opacity_logit", "colour", "pose"))


def assert_renders_nothing(gaussians: Gaussians) -> None:
    gaussian_map, rasterizer = GaussianMap.from_gaussians(gaussians), Rasterizer(CAMERA)
    images = rasterizer.forward(gaussian_map, np.eye(4), with_embedding=True)
    assert not any(image.any() for image in (images.colour, images.depth, images.opacity, images.embedding))
    assert not rasterizer.visible(len(gaussians)).any()
    into = MapGradient.zeros(gaussian_map.capacity)
    ones = np.ones((CAMERA.height, CAMERA.width), np.float32)
    gradient = ImageGradient(np.ones((*ones.shape, 3), np.float32), ones, ones, None, ones, ones)
    assert not rasterizer.backward(gaussian_map, gradient, into).any()
    assert not any(getattr(into, name).any() for name in (*NAMES, "curvature"))


def test_an_empty_map_renders_black() -> None:
    assert_renders_nothing(make_gaussians(mean=np.zeros((0, 3))))


def test_a_rasterizer_forgets_the_last_map() -> None:
    rasterizer = Rasterizer(CAMERA)
    rasterizer.forward(GaussianMap.from_gaussians(random_gaussians(50, CAMERA)), POSE)
    assert not rasterizer.forward(GaussianMap(4), POSE).opacity.any()


def test_gaussians_behind_the_camera_are_not_drawn() -> None:
    mean = [[0.0, 0.0, -1.0], [0.3, 0.1, -0.01], [0.0, 0.0, 0.0], [0.0, 0.0, 0.049], [0.2, 0.0, -3.0]]
    assert_renders_nothing(
        make_gaussians(mean=mean, log_scale=np.full((5, 3), np.log(0.5)), opacity_logit=np.full(5, 3.0))
    )


def test_gaussians_behind_do_not_disturb_those_in_front() -> None:
    front = random_gaussians(20, CAMERA, seed=12)
    behind = front.mean.copy()
    behind[::2] -= np.float32(10.0) * POSE[2, :3].astype(np.float32)  # along the optical axis
    gaussians = make_gaussians(**{**{n: getattr(front, n) for n in NAMES}, "mean": behind})
    assert not project(parameters(gaussians), POSE, CAMERA).in_front[::2].any()
    assert_images_match(gaussians, POSE, CAMERA)
    actual = check_gradients(gaussians, POSE, CAMERA, rows=list(range(1, 20, 4)))
    assert not actual["mean"][::2].any() and not actual["opacity_logit"][::2].any()


# Awkward Gaussians


def test_gaussians_beside_the_camera() -> None:
    """Far off the image the Jacobian is that of a clamped direction, whose gradient is another one."""
    edge_x, edge_y = 0.5 * CAMERA.width / CAMERA.fx, 0.5 * CAMERA.height / CAMERA.fy
    directions = [(1.8, 0.2), (-1.7, -0.1), (0.1, 1.9), (-0.2, -1.8), (1.6, 1.7), (-1.6, 1.5), (0.2, 0.1)]
    rng = np.random.default_rng(13)
    z = rng.uniform(0.8, 1.2, len(directions))
    points_c = np.column_stack([np.array(directions) * [edge_x, edge_y], np.ones(len(z))]) * z[:, None]
    gaussians = make_gaussians(
        mean=(points_c - POSE[:3, 3]) @ POSE[:3, :3],
        log_scale=rng.uniform(np.log(0.3), np.log(0.5), (len(z), 3)),
        quat_wxyz=rng.normal(size=(len(z), 4)),
        opacity_logit=rng.uniform(0.0, 1.0, len(z)),
        colour=rng.uniform(size=(len(z), 3)),
        embedding=rng.normal(size=(len(z), 3)),
    )
    expected = assert_images_match(gaussians, POSE, CAMERA)
    assert (expected.weight.max((1, 2)) > 0.05).all()  # each reaches the image, or the check is void
    check_gradients(gaussians, POSE, CAMERA)


def test_a_gaussian_larger_than_the_image() -> None:
    gaussians = make_gaussians(
        mean=[[0.1, -0.1, 2.0], [0.0, 0.0, 3.0]],
        log_scale=np.log([[8.0, 6.0, 0.01], [0.3, 0.3, 0.3]]),
        quat_wxyz=[[1.0, 0.1, -0.2, 0.3], [1.0, 0.0, 0.0, 0.0]],
        opacity_logit=[0.5, 1.0],
    )
    expected = assert_images_match(gaussians, np.eye(4), CAMERA)
    assert expected.opacity.min() > 0.3
    check_gradients(gaussians, np.eye(4), CAMERA)


@pytest.mark.parametrize("length_m", [0.1, 1.0, 3.0, 10.0])
def test_needles(length_m: float) -> None:
    """Thinner than a pixel, and up to 200 px long and across the pixel grid: where float32 covariances cancel."""
    rng = np.random.default_rng(14)
    needles = random_gaussians(20, CAMERA, seed=14, tangent=0.8)
    log_scale = np.log(np.column_stack([np.full(20, length_m), np.full(20, 2e-3), rng.uniform(1e-4, 1e-2, 20)]))
    gaussians = make_gaussians(**{**{n: getattr(needles, n) for n in NAMES}, "log_scale": log_scale})
    # The depth of a needle that points at the camera changes by its length over a few pixels, and by the second-order
    # term as its square: rounding of the offset grows alike
    assert_images_match(gaussians, POSE, CAMERA, atol=max(ATOL, 3e-5 * length_m**2))
    check_gradients(gaussians, POSE, CAMERA)


def test_large_flat_splats_seen_edge_on() -> None:
    """A wall's splats from the side: needles on the screen with two long axes that project onto the same line."""
    camera = Camera(50, 37, 300.0, 300.0, 24.3, 18.9)
    rng = np.random.default_rng(26)
    n = 12
    tilt = np.deg2rad(rng.uniform(84.0, 90.0, n))  # from facing the camera
    roll = rng.uniform(0.0, np.pi, n)
    half = np.column_stack(
        [np.cos(tilt / 2), np.sin(tilt / 2) * np.cos(roll), np.sin(tilt / 2) * np.sin(roll), 0 * roll]
    )
    gaussians = make_gaussians(
        mean=np.column_stack([rng.uniform(-0.06, 0.06, n), rng.uniform(-0.04, 0.04, n), rng.uniform(0.8, 1.2, n)]),
        log_scale=np.log(np.tile([0.2, 0.15, 1e-3], (n, 1))),
        quat_wxyz=half,
        opacity_logit=rng.uniform(-1.0, 1.0, n),
        colour=rng.uniform(size=(n, 3)),
        embedding=rng.normal(size=(n, 3)),
    )
    assert_images_match(gaussians, np.eye(4), camera)
    check_gradients(gaussians, np.eye(4), camera)


def test_opacities_near_zero_and_one() -> None:
    logits = np.concatenate([np.linspace(-7.0, -4.0, 15), np.linspace(3.0, 12.0, 10)])
    scene = random_gaussians(25, CAMERA, seed=15)
    gaussians = make_gaussians(**{**{n: getattr(scene, n) for n in NAMES}, "opacity_logit": logits})
    assert_images_match(gaussians, POSE, CAMERA)
    check_directions(gaussians, POSE, CAMERA)
    actual = check_gradients(gaussians, POSE, CAMERA, names=("colour", "mean"))
    fainter = logits < np.log(ALPHA_MIN / (1.0 - ALPHA_MIN)) - 0.01
    assert fainter.any() and not actual["colour"][fainter].any() and not actual["mean"][fainter].any()


def test_saturated_pixels_have_no_gradient_through_alpha() -> None:
    gaussians = make_gaussians(
        mean=[[0.0, 0.0, 2.0], [0.05, 0.02, 3.0]],
        log_scale=np.log([[0.4, 0.4, 0.01], [0.5, 0.5, 0.5]]),
        opacity_logit=[9.0, 0.5],
        colour=[[0.9, 0.2, 0.1], [0.1, 0.8, 0.9]],
    )
    saturated = render(parameters(gaussians), np.eye(4), CAMERA).weight[0] == 0.99
    assert 5 < saturated.sum() < saturated.size
    zeros = np.zeros(saturated.shape, np.float32)
    gradient = ImageGradient(np.float32(np.repeat(saturated[..., None], 3, 2)), zeros, zeros)
    actual = kernel_gradients(gaussians, np.eye(4), CAMERA, gradient)
    for name in ("mean", "log_scale", "quat_wxyz", "opacity_logit"):
        assert not actual[name][0].any(), name
    np.testing.assert_allclose(actual["colour"][0], 0.99 * saturated.sum(), rtol=1e-5)
    assert actual["opacity_logit"][1] > 0  # the one behind still has its hundredth
    assert_images_match(gaussians, np.eye(4), CAMERA)
    check_gradients(gaussians, np.eye(4), CAMERA, names=("mean", "log_scale", "opacity_logit", "colour", "pose"))


def test_equal_depths_are_drawn_by_index() -> None:
    rng = np.random.default_rng(16)
    n = 40
    mean = np.column_stack([rng.uniform(-0.6, 0.6, n), rng.uniform(-0.4, 0.4, n), np.full(n, 2.0)])
    gaussians = make_gaussians(
        mean=mean,
        opacity_logit=rng.uniform(0.0, 2.0, n),
        colour=rng.uniform(size=(n, 3)),
        embedding=rng.normal(size=(n, 3)),
    )
    assert decisions_at(parameters(gaussians), np.eye(4), CAMERA).order == list(range(n))
    forwards = assert_images_match(gaussians, np.eye(4), CAMERA)
    check_gradients(gaussians, np.eye(4), CAMERA, rows=list(range(0, n, 4)), names=("opacity_logit", "mean", "pose"))
    reverse = make_gaussians(**{name: getattr(gaussians, name)[::-1] for name in NAMES})
    backwards = assert_images_match(reverse, np.eye(4), CAMERA)
    assert np.abs(forwards.colour - backwards.colour).max() > 0.05  # the order shows


@pytest.mark.parametrize("factor", [1.0 - 1e-3, 1.0, 1.0 + 1e-3])
def test_alpha_at_the_threshold(factor: float) -> None:
    """A splat on a pixel's centre whose peak is just below, at, and just above 1/255: that pixel alone, or nothing."""
    opacity = factor * ALPHA_MIN
    camera = Camera(20, 20, 20.0, 20.0, 9.0, 6.0)
    gaussians = make_gaussians(
        mean=[[0.0, 0.0, 2.0]], opacity_logit=[np.log(opacity / (1.0 - opacity))], colour=np.ones((1, 3))
    )
    images = Rasterizer(camera).forward(GaussianMap.from_gaussians(gaussians), np.eye(4))
    drawn = np.argwhere(images.opacity).tolist()
    assert drawn in ([], [[6, 9]])
    if factor != 1.0:
        assert bool(drawn) == (factor > 1.0)
    if drawn:
        np.testing.assert_allclose(images.colour[6, 9], opacity, rtol=1e-4)
    ones = np.ones((20, 20), np.float32)
    gradient = ImageGradient(np.ones((20, 20, 3), np.float32), ones, ones)
    actual = kernel_gradients(gaussians, np.eye(4), camera, gradient)
    assert bool(actual["colour"].any()) == bool(drawn)
    assert all(np.isfinite(values).all() for values in actual.values())


def test_the_drawn_set_of_pixels_is_the_twins() -> None:
    """One splat a picture: opacity is non-zero exactly where the twin's alpha passes, so culling cuts nothing off."""
    scene = random_gaussians(300, CAMERA, seed=17, tangent=1.2, scale_m=(0.01, 0.4), logit=(-5.0, 4.0))
    rasterizer = Rasterizer(CAMERA)
    for i in range(len(scene)):
        one = make_gaussians(**{name: getattr(scene, name)[i : i + 1] for name in NAMES})
        p = parameters(one)
        drawn = rasterizer.forward(GaussianMap.from_gaussians(one), POSE).opacity > 0
        decided = ~undecided(p, POSE, CAMERA, BAND)
        np.testing.assert_array_equal(drawn[decided], decisions_at(p, POSE, CAMERA).drawn[0][decided])


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("last_pixel", "side"), [(15, -1.0), (32, 1.0)])
def test_a_splat_reaches_into_the_next_tile_by_a_hair(axis: int, last_pixel: int, side: float) -> None:
    """A round splat on the optical axis whose rim passes a pixel of the neighbouring tile by 0.02 px."""
    opacity, scale_px = 0.6, 2.5
    reach = np.sqrt(2.0 * np.log(opacity / ALPHA_MIN) * (scale_px**2 + BLUR))
    centre = [24.0, 24.0]
    centre[axis] = last_pixel - side * (reach - 0.02)
    camera = Camera(48, 48, 50.0, 50.0, *centre)
    gaussians = make_gaussians(
        mean=[[0.0, 0.0, 1.0]],
        log_scale=np.full((1, 3), np.log(scale_px / 50.0)),
        opacity_logit=[np.log(opacity / (1.0 - opacity))],
    )
    images = Rasterizer(camera).forward(GaussianMap.from_gaussians(gaussians), np.eye(4))
    drawn = np.argwhere(images.opacity)[:, 1 - axis]  # columns for x, rows for y
    assert (drawn.max() if side > 0 else drawn.min()) == last_pixel


def test_a_thousand_gaussians_in_a_tile() -> None:
    gaussians = random_gaussians(1500, TILE_CAMERA, seed=18, scale_m=(0.05, 0.3), logit=(-5.0, -3.0))
    assert_images_match(gaussians, POSE, TILE_CAMERA, most_left_out=0.3)  # 1,500 rims cross many pixels
    gaussian_map, rasterizer = GaussianMap.from_gaussians(gaussians), Rasterizer(TILE_CAMERA)
    rasterizer.forward(gaussian_map, POSE)
    assert rasterizer.slot_count > 1000
    check_directions(gaussians, POSE, TILE_CAMERA)


# Early stop


def opaque_stack(layers: int) -> Gaussians:
    """Opaque sheets one behind another that fill the tile, in an order that is not the depth order."""
    rng = np.random.default_rng(19)
    z = rng.permutation(np.linspace(1.0, 3.0, layers))
    return make_gaussians(
        mean=np.column_stack([rng.uniform(-0.1, 0.1, (layers, 2)), z]),
        log_scale=np.log(np.tile([3.0, 3.0, 0.01], (layers, 1))),
        opacity_logit=rng.uniform(1.5, 2.5, layers),
        colour=rng.uniform(size=(layers, 3)),
        embedding=rng.normal(size=(layers, 3)),
    )


def test_what_an_opaque_tile_hides() -> None:
    """Forward: within the transmittance left. Backward: the front agrees, and what is hidden has no gradient at all."""
    gaussians = opaque_stack(40)
    expected = assert_images_match(gaussians, np.eye(4), TILE_CAMERA, atol=4.0 * T_MIN)  # depths of up to 4 m
    by_depth = np.argsort(gaussians.mean[:, 2])
    behind = expected.weight[by_depth].cumsum(0).max((1, 2)) > 1.0 - 1e-9
    actual = check_gradients(
        gaussians,
        np.eye(4),
        TILE_CAMERA,
        rows=by_depth[:3].tolist(),
        names=("mean", "log_scale", "opacity_logit", "pose"),
    )
    assert behind.any()
    for name in NAMES:
        assert not actual[name][by_depth[behind]].any(), name


def test_hidden_gaussians_change_neither_image_nor_gradients() -> None:
    """The backward pass must stop where the forward pass did, or the two describe different functions."""
    stack = opaque_stack(40)
    order = np.argsort(stack.mean[:, 2])
    front = make_gaussians(**{name: getattr(stack, name)[order[:16]] for name in NAMES})
    whole = make_gaussians(**{name: getattr(stack, name)[order] for name in NAMES})
    gradient = Functional(parameters(front), np.eye(4), TILE_CAMERA).image_gradient()
    a = kernel_gradients(front, np.eye(4), TILE_CAMERA, gradient)
    b = kernel_gradients(whole, np.eye(4), TILE_CAMERA, gradient)
    for name in NAMES:
        np.testing.assert_array_equal(a[name], b[name][:16], err_msg=name)
    np.testing.assert_array_equal(a["pose"], b["pose"])


# Repeatability


def everything(gaussian_map: GaussianMap, rasterizer: Rasterizer, gradient: ImageGradient) -> dict[str, bytes]:
    """Bytes of all outputs of a forward and a backward pass."""
    images = rasterizer.forward(gaussian_map, POSE, with_embedding=True)
    into = MapGradient.zeros(gaussian_map.capacity)
    pose = rasterizer.backward(gaussian_map, gradient, into)
    outputs = {name: getattr(images, name) for name in ("colour", "depth", "opacity", "embedding")}
    outputs |= {f"grad {name}": getattr(into, name)[: gaussian_map.count] for name in NAMES}
    return {name: array.tobytes() for name, array in (outputs | {"pose": pose}).items()}


def test_results_repeat_bit_for_bit() -> None:
    gaussians = random_gaussians(1500, CAMERA, seed=20)  # three blocks of the pose sum, many slots a tile
    gradient = Functional(parameters(make_gaussians(mean=np.ones((1, 3)))), POSE, CAMERA).image_gradient()
    gaussian_map, rasterizer = GaussianMap.from_gaussians(gaussians), Rasterizer(CAMERA)
    first = everything(gaussian_map, rasterizer, gradient)
    assert everything(gaussian_map, rasterizer, gradient) == first  # same memory
    assert everything(GaussianMap.from_gaussians(gaussians), Rasterizer(CAMERA), gradient) == first  # fresh memory


def test_results_do_not_depend_on_capacity_or_history() -> None:
    gaussians = random_gaussians(60, CAMERA, seed=21)
    gradient = Functional(parameters(gaussians), POSE, CAMERA).image_gradient()
    expected = everything(GaussianMap.from_gaussians(gaussians), Rasterizer(CAMERA), gradient)
    for capacity in (1, 61, 1000):
        gaussian_map = GaussianMap(capacity)
        for part in (slice(0, 7), slice(7, 60)):
            gaussian_map.append(_rows(gaussians, part))
        assert everything(gaussian_map, Rasterizer(CAMERA), gradient) == expected, capacity
    rasterizer = Rasterizer(CAMERA)
    rasterizer.forward(GaussianMap.from_gaussians(random_gaussians(900, CAMERA, seed=22)), POSE)
    assert everything(GaussianMap.from_gaussians(gaussians), rasterizer, gradient) == expected


def test_depth_order_after_append_and_keep() -> None:
    gaussians = random_gaussians(60, CAMERA, seed=23)
    mask = np.random.default_rng(24).random(60) > 0.4
    gaussian_map, rasterizer = GaussianMap(8), Rasterizer(CAMERA)
    gaussian_map.append(_rows(gaussians, slice(0, 60)))
    rasterizer.forward(gaussian_map, POSE)
    gaussian_map.keep(mask)
    gaussian_map.append(_rows(gaussians, ~mask))  # the same set in another order of rows
    images = rasterizer.forward(gaussian_map, POSE)
    whole = Rasterizer(CAMERA).forward(GaussianMap.from_gaussians(gaussians), POSE)
    np.testing.assert_array_equal(images.colour, whole.colour)  # depths differ, so the order of blending is the same
    np.testing.assert_array_equal(images.depth, whole.depth)


def test_slots_grow_beyond_the_first_allocation() -> None:
    """More slots than the scratch memory holds at first."""
    camera = Camera(160, 128, 80.0, 80.0, 79.5, 63.5)  # 80 tiles
    n = 500
    rng = np.random.default_rng(25)
    gaussians = make_gaussians(
        mean=np.column_stack([rng.uniform(-0.1, 0.1, (n, 2)), rng.uniform(1.0, 3.0, n)]),
        log_scale=np.full((n, 3), np.log(3.0)),
        opacity_logit=np.full(n, -5.0),
        colour=rng.uniform(size=(n, 3)),
    )
    rasterizer = Rasterizer(camera)
    images = rasterizer.forward(GaussianMap.from_gaussians(gaussians), np.eye(4))
    assert rasterizer.slot_count > 1 << 15
    expected = render(parameters(gaussians), np.eye(4), camera)
    np.testing.assert_allclose(images.colour, expected.colour, atol=5e-3)


def _rows(gaussians: Gaussians, which: slice | np.ndarray) -> Gaussians:
    return Gaussians(**{name: values[which] for name, values in vars(gaussians).items()})


# Tangent-plane depth


def test_a_tilted_flat_splat_renders_the_depth_of_its_plane() -> None:
    """To first order about its centre; the centre's depth alone would be off by the slope times the offset."""
    camera = Camera(64, 64, 120.0, 120.0, 31.5, 31.5)
    centre, half_angle = np.array([0.06, -0.04, 2.0]), 0.5 * np.deg2rad(50.0)
    axis = np.array([0.6, 0.8, 0.0])
    gaussians = make_gaussians(
        mean=[centre],
        log_scale=np.log([[0.3, 0.3, 1e-4]]),
        quat_wxyz=[[np.cos(half_angle), *(np.sin(half_angle) * axis)]],
        opacity_logit=[4.0],
    )
    images = Rasterizer(camera).forward(GaussianMap.from_gaussians(gaussians), np.eye(4))
    turn = se3_exp([*(2.0 * half_angle * axis), 0.0, 0.0, 0.0])[:3, :3]
    normal = turn @ [0.0, 0.0, 1.0]
    v, u = np.mgrid[:64, :64]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    plane_depth = (normal @ centre) / (rays @ normal)
    offset = np.hypot(u - (camera.fx * 0.03 + camera.cx), v - (camera.fy * -0.02 + camera.cy))
    near = offset < 6.0
    rendered = images.depth / np.maximum(images.opacity, 1e-6)
    error, centre_error = np.abs(rendered - plane_depth)[near], np.abs(centre[2] - plane_depth)[near]
    assert centre_error.max() > 0.1
    assert error.max() < 0.1 * centre_error.max()
    inner = offset[near] < 3.0  # first order: half the offset, a quarter of the error
    assert error[inner].max() < 0.35 * error.max()
