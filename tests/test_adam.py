"""Adam against its twin, and moments that follow their rows."""

import numpy as np
import pytest

from tests.reference import adam as reference
from tgslam.device import runtime
from tgslam.ops.adam import Adam


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_matches_the_twin_with_rows_that_come_and_go(rng):
    rows, shapes = 37, {"mean": (37, 3), "opacity": (37,), "quat": (37, 4), "scale": (37, 3), "colour": (37, 3)}
    rates = {"mean": 1e-2, "opacity": 5e-2, "quat": 2e-3, "scale": 4e-3, "colour": 1e-3}
    adam = Adam({name: shape[1] if len(shape) > 1 else 0 for name, shape in shapes.items()}, rates, rows)
    start = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    values = {name: runtime.to_device(value) for name, value in start.items()}
    twins = {name: reference.Adam(shape, rates[name]) for name, shape in shapes.items()}
    for _ in range(25):
        gradients = {name: rng.normal(size=shape) * 10.0 ** rng.integers(-6, 3) for name, shape in shapes.items()}
        visible = rng.random(rows) < 0.6
        adam.step(
            values,
            {name: runtime.to_device(g) for name, g in gradients.items()},
            runtime.to_device(visible, np.int32),
        )
        for name, twin in twins.items():
            twin.step(start[name], gradients[name], visible)
    for name in shapes:
        np.testing.assert_allclose(runtime.to_host(values[name]), start[name], rtol=2e-5, atol=2e-5)
        m, v = adam.moments(name)
        np.testing.assert_allclose(m, twins[name].m, rtol=1e-4, atol=1e-6 * abs(twins[name].m).max())
        np.testing.assert_allclose(v, twins[name].v, rtol=1e-4)
    np.testing.assert_array_equal(adam.step_counts(), twins["mean"].t)


def test_first_step_has_the_length_of_the_rate_whatever_the_gradient():
    adam = Adam({"x": 2}, {"x": 0.1}, 3)
    x = runtime.zeros((3, 2))
    adam.step({"x": x}, {"x": runtime.to_device([[1e-4, -1e4], [1e-8, -3.0], [0.0, 2.0]])})
    np.testing.assert_allclose(runtime.to_host(x), [[-0.1, 0.1], [-0.1, 0.1], [0.0, -0.1]], rtol=1e-5)


def test_pace_scales_the_step_and_leaves_the_moments():
    full, half = (Adam({"x": 2}, {"x": 0.1}, 3) for _ in range(2))
    x, y = runtime.zeros((3, 2)), runtime.zeros((3, 2))
    gradient = runtime.to_device([[1.0, -2.0], [3.0, 4.0], [0.0, 0.5]])
    full.step({"x": x}, {"x": gradient})
    half.step({"x": y}, {"x": gradient}, pace=0.5)
    np.testing.assert_allclose(runtime.to_host(y), 0.5 * runtime.to_host(x), rtol=1e-6)
    for one, other in zip(full.moments("x"), half.moments("x"), strict=True):
        np.testing.assert_array_equal(one, other)


def test_invisible_rows_are_bitwise_untouched(rng):
    adam = Adam({"x": 4}, {"x": 0.1}, 50)
    x = runtime.to_device(rng.normal(size=(50, 4)))
    visible = np.arange(50) % 3 == 0
    before = runtime.to_host(x).copy()
    adam.step({"x": x}, {"x": runtime.to_device(rng.normal(size=(50, 4)))}, runtime.to_device(visible, np.int32))
    after = runtime.to_host(x)
    assert (after[~visible] == before[~visible]).all()
    assert (after[visible] != before[visible]).all()
    assert (adam.moments("x")[0][~visible] == 0).all()
    np.testing.assert_array_equal(adam.step_counts(), visible)


@pytest.mark.parametrize("by_mask", [True, False])
def test_moments_move_with_their_rows(rng, by_mask):
    adam = Adam({"x": 3, "y": 0}, {"x": 0.1, "y": 0.1}, 10)
    gradients = {"x": runtime.to_device(rng.normal(size=(10, 3))), "y": runtime.to_device(rng.normal(size=10))}
    adam.step({"x": runtime.zeros((10, 3)), "y": runtime.zeros((10,))}, gradients)
    m, v = (moment.copy() for moment in adam.moments("x"))
    kept = np.array([0, 4, 5, 9])
    adam.keep(np.isin(np.arange(10), kept) if by_mask else kept)
    adam.append(200)  # beyond the capacity
    assert adam.rows == 204
    np.testing.assert_array_equal(adam.moments("x")[0][:4], m[kept])
    np.testing.assert_array_equal(adam.moments("x")[1][:4], v[kept])
    assert adam.moments("y")[0].shape == (204,)
    assert (adam.moments("x")[0][4:] == 0).all()
    np.testing.assert_array_equal(adam.step_counts(), [1] * 4 + [0] * 200)


def test_groups_that_are_not_given_rest(rng):
    adam, alone = (Adam(dict.fromkeys(names, 2), dict.fromkeys(names, 0.1), 6) for names in ("xyz", "y"))
    gradient = runtime.to_device(rng.normal(size=(6, 2)))
    both = runtime.zeros((6, 2)), runtime.zeros((6, 2))
    for optimiser, y in zip((adam, alone), both, strict=True):
        optimiser.step({"y": y}, {"y": gradient})
    np.testing.assert_array_equal(*(runtime.to_host(y) for y in both))
    np.testing.assert_array_equal(adam.moments("y"), alone.moments("y"))
    assert not np.any(adam.moments("x")) and not np.any(adam.moments("z"))


def test_rows_that_left_leave_no_moments_behind(rng):
    adam = Adam({"x": 2}, {"x": 0.1}, 8)
    adam.step({"x": runtime.zeros((8, 2))}, {"x": runtime.to_device(rng.normal(size=(8, 2)))})
    adam.keep(np.arange(3))
    adam.append(5)
    assert (adam.moments("x")[0][3:] == 0).all() and (adam.moments("x")[1][3:] == 0).all()


def test_arrays_may_have_spare_capacity(rng):
    adam = Adam({"x": 2}, {"x": 0.1}, 5)
    x = runtime.zeros((9, 2))
    adam.step({"x": x}, {"x": runtime.to_device(np.ones((9, 2)))})
    assert (runtime.to_host(x)[:5] != 0).all() and (runtime.to_host(x)[5:] == 0).all()


def test_minimises_a_badly_scaled_quadratic():
    adam = Adam({"x": 3}, {"x": 0.05}, 1)
    x, scale = runtime.to_device([[1.0, -2.0, 0.5]]), np.array([[1e-3, 1.0, 1e3]])
    for _ in range(300):
        adam.step({"x": x}, {"x": runtime.to_device(runtime.to_host(x) * scale)})
    assert abs(runtime.to_host(x)).max() < 0.02


def test_wrong_arguments_are_named(rng):
    with pytest.raises(ValueError, match="learning rates"):
        Adam({"x": 2}, {"y": 0.1}, 5)
    with pytest.raises(ValueError, match="at most 5 groups"):
        Adam(dict.fromkeys("abcdef", 1), dict.fromkeys("abcdef", 0.1))
    adam = Adam({"x": 2}, {"x": 0.1}, 5)
    good = runtime.zeros((5, 2))
    with pytest.raises(ValueError, match="unknown group 'z'"):
        adam.step({"z": good}, {"z": good})
    with pytest.raises(ValueError, match=r"gradient 'x' must have shape \[5, 2\], but has \[5, 3\]"):
        adam.step({"x": good}, {"x": runtime.zeros((5, 3))})
    with pytest.raises(ValueError, match="visible must be int32"):
        adam.step({"x": good}, {"x": good}, np.ones(5, bool))
    with pytest.raises(IndexError, match=r"0\.\.4"):
        adam.keep(np.array([0, 5]))
    with pytest.raises(ValueError, match="kept"):
        adam.keep(np.ones(4, bool))
