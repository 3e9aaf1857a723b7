"""Adam in float64 NumPy, one row at a time."""

import numpy as np


class Adam:
    def __init__(self, shape, rate, beta1=0.9, beta2=0.999, epsilon=1e-15):
        self.m, self.v, self.t = np.zeros(shape), np.zeros(shape), np.zeros(shape[0], int)
        self.rate, self.beta1, self.beta2, self.epsilon = rate, beta1, beta2, epsilon

    def step(self, parameter, gradient, visible=None):
        for row in range(len(parameter)):
            if visible is not None and not visible[row]:
                continue
            self.t[row] += 1
            self.m[row] = self.beta1 * self.m[row] + (1 - self.beta1) * gradient[row]
            self.v[row] = self.beta2 * self.v[row] + (1 - self.beta2) * gradient[row] ** 2
            m_hat = self.m[row] / (1 - self.beta1 ** self.t[row])
            v_hat = self.v[row] / (1 - self.beta2 ** self.t[row])
            parameter[row] -= self.rate * m_hat / (np.sqrt(v_hat) + self.epsilon)
