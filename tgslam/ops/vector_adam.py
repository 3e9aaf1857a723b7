"""Adam on a small host vector: a pose twist, gain and bias."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


class VectorAdam:
    """Adam with a step size per component, in the component's unit."""

    def __init__(self, rates: ArrayLike, betas: tuple[float, float] = (0.9, 0.999)) -> None:
        self.rates = np.asarray(rates, np.float64)
        self._betas = betas
        self._m, self._v, self._t = np.zeros_like(self.rates), np.zeros_like(self.rates), 0

    def step(self, gradient: ArrayLike) -> NDArray[np.float64]:
        """The change [n] to add (for a pose twist: to apply on the left), given the gradient [n]."""
        gradient = np.asarray(gradient, np.float64)
        beta1, beta2 = self._betas
        self._t += 1
        self._m = beta1 * self._m + (1.0 - beta1) * gradient
        self._v = beta2 * self._v + (1.0 - beta2) * gradient**2
        m, v = self._m / (1.0 - beta1**self._t), self._v / (1.0 - beta2**self._t)
        return -self.rates * m / (np.sqrt(v) + 1e-12)
