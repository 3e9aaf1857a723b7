"""Adam against its twin, and moments that follow their rows."""

import numpy as np
import pytest

from tests.reference import adam as reference
from tgslam.device import runtime
from tgslam.ops.adam import Adam


class Rows:
    """An optimiser with the memory of some rows."""

    def __init__(self, channels, rates, rows, spare=0):
        self.adam, self.rows = Adam(channels, rates), rows
        self.moments = runtime.zeros((rows + spare, self.adam.moment_width))
        self.steps = runtime.zeros((rows + spare,), np.int32)

    def step(self, parameters, gradients, visible=None, **options):
        visible = runtime.to_device(np.ones(self.rows) if visible is None else visible, np.int32)
        self.adam.step(self.rows, parameters, gradients, self.moments, self.steps, visible, **options)

    def moments_of(self, group):
        return self.adam.moments_of(group, self.moments)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_matches_the_twin(rng):
    rows, shapes = 37, {"mean": (37, 3), "opacity": (37,), "quat": (37, 4), "scale": (37, 3), "colour": (37, 3)}
    rates = {"mean": 1e-2, "opacity": 5e-2, "quat": 2e-3, "scale": 4e-3, "colour": 1e-3}
    adam = Rows({name: shape[1] if len(shape) > 1 else 0 for name, shape in shapes.items()}, rates, rows)
    start = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    values = {name: runtime.to_device(value) for name, value in start.items()}
    twins = {name: reference.Adam(shape, rates[name]) for name, shape in shapes.items()}
    for _ in range(25):
        gradients = {name: rng.normal(size=shape) * 10.0 ** rng.integers(-6, 3) for name, shape in shapes.items()}
        visible = rng.random(rows) < 0.6
        adam.step(values, {name: runtime.to_device(g) for name, g in gradients.items()}, visible)
        for name, twin in twins.items():
            twin.step(start[name], gradients[name], visible)
    for name in shapes:
        np.testing.assert_allclose(runtime.to_host(values[name]), start[name], rtol=2e-5, atol=2e-5)
        m, v = adam.moments_of(name)
        np.testing.assert_allclose(m, twins[name].m, rtol=1e-4, atol=1e-6 * abs(twins[name].m).max())
        np.testing.assert_allclose(v, twins[name].v, rtol=1e-4)
    np.testing.assert_array_equal(runtime.to_host(adam.steps), twins["mean"].t)


def test_first_step_has_the_length_of_the_rate_whatever_the_gradient():
    adam = Rows({"x": 2}, {"x": 0.1}, 3)
    x = runtime.zeros((3, 2))
    adam.step({"x": x}, {"x": runtime.to_device([[1e-4, -1e4], [1e-8, -3.0], [0.0, 2.0]])})
    np.testing.assert_allclose(runtime.to_host(x), [[-0.1, 0.1], [-0.1, 0.1], [0.0, -0.1]], rtol=1e-5)


def test_pace_scales_the_step_and_leaves_the_moments():
    full, half = (Rows({"x": 2}, {"x": 0.1}, 3) for _ in range(2))
    x, y = runtime.zeros((3, 2)), runtime.zeros((3, 2))
    gradient = runtime.to_device([[1.0, -2.0], [3.0, 4.0], [0.0, 0.5]])
    full.step({"x": x}, {"x": gradient})
    half.step({"x": y}, {"x": gradient}, pace=0.5)
    np.testing.assert_allclose(runtime.to_host(y), 0.5 * runtime.to_host(x), rtol=1e-6)
    for one, other in zip(full.moments_of("x"), half.moments_of("x"), strict=True):
        np.testing.assert_array_equal(one, other)


def test_invisible_rows_are_bitwise_untouched(rng):
    adam = Rows({"x": 4}, {"x": 0.1}, 50)
    x = runtime.to_device(rng.normal(size=(50, 4)))
    visible = np.arange(50) % 3 == 0
    before = runtime.to_host(x).copy()
    adam.step({"x": x}, {"x": runtime.to_device(rng.normal(size=(50, 4)))}, visible)
    after = runtime.to_host(x)
    assert (after[~visible] == before[~visible]).all()
    assert (after[visible] != before[visible]).all()
    assert (adam.moments_of("x")[0][~visible] == 0).all()
    np.testing.assert_array_equal(runtime.to_host(adam.steps), visible)


def test_groups_that_are_not_given_rest(rng):
    adam, alone = (Rows(dict.fromkeys(names, 2), dict.fromkeys(names, 0.1), 6) for names in ("xyz", "y"))
    gradient = runtime.to_device(rng.normal(size=(6, 2)))
    both = runtime.zeros((6, 2)), runtime.zeros((6, 2))
    for optimiser, y in zip((adam, alone), both, strict=True):
        optimiser.step({"y": y}, {"y": gradient})
    np.testing.assert_array_equal(*(runtime.to_host(y) for y in both))
    np.testing.assert_array_equal(adam.moments_of("y"), alone.moments_of("y"))
    assert not np.any(adam.moments_of("x")) and not np.any(adam.moments_of("z"))


def test_arrays_may_have_spare_capacity(rng):
    adam = Rows({"x": 2}, {"x": 0.1}, 5, spare=4)
    x = runtime.zeros((9, 2))
    adam.step({"x": x}, {"x": runtime.to_device(np.ones((9, 2)))})
    assert (runtime.to_host(x)[:5] != 0).all() and (runtime.to_host(x)[5:] == 0).all()


def test_minimises_a_badly_scaled_quadratic():
    adam = Rows({"x": 3}, {"x": 0.05}, 1)
    x, scale = runtime.to_device([[1.0, -2.0, 0.5]]), np.array([[1e-3, 1.0, 1e3]])
    for _ in range(300):
        adam.step({"x": x}, {"x": runtime.to_device(runtime.to_host(x) * scale)})
    assert abs(runtime.to_host(x)).max() < 0.02


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="learning rates"):
        Adam({"x": 2}, {"y": 0.1})
    with pytest.raises(ValueError, match="at most 5 groups"):
        Adam(dict.fromkeys("abcdef", 1), dict.fromkeys("abcdef", 0.1))
    adam = Rows({"x": 2}, {"x": 0.1}, 5)
    good = runtime.zeros((5, 2))
    with pytest.raises(ValueError, match="unknown group 'z'"):
        adam.step({"z": good}, {"z": good})
    with pytest.raises(ValueError, match=r"gradient 'x' must have shape \[5, 2\], but has \[5, 3\]"):
        adam.step({"x": good}, {"x": runtime.zeros((5, 3))})
    with pytest.raises(ValueError, match="visible must be int32"):
        adam.adam.step(5, {"x": good}, {"x": good}, adam.moments, adam.steps, np.ones(5, bool))
    with pytest.raises(ValueError, match=r"moments must have shape \[5, 4\]"):
        adam.adam.step(5, {"x": good}, {"x": good}, runtime.zeros((5, 3)), adam.steps, adam.steps)
