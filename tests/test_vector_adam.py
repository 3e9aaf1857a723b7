"""Adam on a host vector."""

import numpy as np
import pytest

from tgslam.ops.vector_adam import VectorAdam

RATES = [0.1, 0.01, 0.001]


def test_the_first_step_is_the_rate_against_the_gradient():
    step = VectorAdam(RATES).step([1e-3, -5.0, 2e4])
    np.testing.assert_allclose(step, [-0.1, 0.01, -0.001], rtol=1e-6)


def test_no_gradient_no_step():
    adam = VectorAdam(RATES)
    np.testing.assert_array_equal(adam.step(np.zeros(3)), np.zeros(3))
    assert adam.step([1.0, 0.0, 0.0])[0] < 0


def test_steps_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    gradients = rng.normal(size=(20, 3))
    adam, betas = VectorAdam(RATES, (0.8, 0.95)), (0.8, 0.95)
    for t in range(1, 21):
        age = t - 1 - np.arange(t)
        m, v = ((1 - b) * b**age @ gradients[:t] ** k / (1 - b**t) for k, b in enumerate(betas, start=1))
        np.testing.assert_allclose(adam.step(gradients[t - 1]), -np.array(RATES) * m / np.sqrt(v), rtol=1e-9)


def test_it_finds_the_minimum_of_a_badly_scaled_bowl():
    adam, x, scale = VectorAdam([0.02] * 3), np.array([1.0, -1.0, 0.5]), np.array([1e-4, 1.0, 1e4])
    for _ in range(600):
        x = x + adam.step(scale * x)
    assert abs(x).max() < 1e-2


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_scale_of_the_gradient_does_not_matter(scale):
    one, other = VectorAdam(RATES), VectorAdam(RATES)
    for gradient in np.random.default_rng(1).normal(size=(10, 3)):
        np.testing.assert_allclose(one.step(gradient), other.step(scale * gradient), rtol=1e-4)
