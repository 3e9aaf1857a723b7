"""Normal equations of RGB-D alignment in float64 NumPy, pixel by pixel: residuals, Jacobians and weights apart."""

from dataclasses import dataclass

import numpy as np

from tgslam.geometry import hat

NEAR_M, MIN_COSINE, INLIER_SIGMAS, MIN_DEPTH_M = 0.05, 0.2, 3.0, 1e-3


@dataclass
class Settings:
    fx: float
    fy: float
    cx: float
    cy: float
    gain: float = 1.0
    bias: float = 0.0
    depth_sigma: float = 0.0015
    max_distance_sigmas: float = 15.0
    charbonnier_depth: float = 1.0
    gate_depth_boost: float = 1.0
    sigma_colour: float = 0.05
    sigma_gradient: float = 0.02
    weight_depth: float = 1.0
    weight_colour: float = 0.1
    weight_gradient: float = 0.1
    surface_sigma: float = 0.0
    live_share: float = 0.0


@dataclass
class Term:
    """weight * (epsilon^2 sqrt(1 + |e|^2 / epsilon^2)), to be minimised; e [K], jacobian [K, 6]."""

    e: np.ndarray
    jacobian: np.ndarray
    weight: float
    epsilon: float = 1.0

    @property
    def robust(self):
        return 1 / np.sqrt(1 + self.e @ self.e / self.epsilon**2)

    @property
    def cost(self):
        return self.weight * self.epsilon**2 * (np.sqrt(1 + self.e @ self.e / self.epsilon**2) - 1)


@dataclass
class Pixel:
    """What one live pixel says; the terms are None where they do not apply."""

    matched: bool
    depth: Term | None = None
    colour: Term | None = None
    gradient: Term | None = None
    live: float = 0.0
    model: float = 0.0
    sensor_sigmas: float = 0.0  # of the depth residual, where there is one
    colour_sigmas: float = 0.0  # of the intensity residual


def bilinear(image, u, v):
    x, y = int(u), int(v)
    a, b = u - x, v - y
    top = (1 - a) * image[y, x] + a * image[y, x + 1]
    bottom = (1 - a) * image[y + 1, x] + a * image[y + 1, x + 1]
    return (1 - b) * top + b * bottom


def back_project(s, u, v, z):
    return np.array([(u - s.cx) / s.fx * z, (v - s.cy) / s.fy * z, z])


def project(s, x):
    return np.array([s.fx * x[0] / x[2] + s.cx, s.fy * x[1] / x[2] + s.cy])


def pixel(s, T_ml, live, model, u, v):
    """The terms of live pixel (u, v), or None where it meets no model pixel. live, model: dicts of images."""
    height, width = live["depth"].shape
    z = live["depth"][v, u]
    if z <= 0:
        return None
    ray = back_project(s, u, v, z)
    x = T_ml[:3, :3] @ ray + T_ml[:3, 3]
    if x[2] <= NEAR_M:
        return None
    um, vm = project(s, x)
    if um < 1 or vm < 1 or um >= width - 2 or vm >= height - 2:
        return None
    un, vn = int(np.floor(um + 0.5)), int(np.floor(vm + 0.5))
    rim, zm = model["depth"][vn, un] < 0, abs(model["depth"][vn, un])
    if zm == 0:
        return None
    n = model["normal"][vn, un]
    distance, cosine = n @ (x - back_project(s, un, vn, zm)), max(-n @ ray / np.linalg.norm(ray), MIN_COSINE)
    sensor = s.depth_sigma * max(s.live_share * x[2] + (1 - s.live_share) * zm, MIN_DEPTH_M) ** 2
    along = abs(distance) / cosine if n.any() else abs(x[2] - zm)
    if along >= s.max_distance_sigmas * sensor:
        return Pixel(matched=False)
    moves = np.hstack([-hat(x), np.eye(3)])  # d x / d xi
    shifts = np.array([[s.fx, 0, -s.fx * x[0] / x[2]], [0, s.fy, -s.fy * x[1] / x[2]]]) / x[2] @ moves
    result = Pixel(matched=True, live=live["grey"][v, u], model=bilinear(model["grey"], um, vm))
    gate = live["gate"][v, u]
    if n.any():
        weight = s.weight_depth * (1 + s.gate_depth_boost * gate)
        scale = 1 / ((sensor + s.surface_sigma) * cosine)
        result.sensor_sigmas = abs(distance) / (sensor * cosine)
        result.depth = Term(np.array([distance * scale]), scale * (n @ moves)[None], weight, s.charbonnier_depth)
    slope = np.array([bilinear(model[name], um, vm) for name in ("gx", "gy")])
    e = np.array([result.model - s.gain * result.live - s.bias])
    if rim or live["saturated"][v, u]:
        return result
    result.colour_sigmas = abs(e[0]) / s.sigma_colour
    result.colour = Term(e / s.sigma_colour, (slope @ shifts)[None] / s.sigma_colour, s.weight_colour)
    if gate < 1:
        gxx, gxy, gyy = (bilinear(model[name], um, vm) for name in ("gxx", "gxy", "gyy"))
        e = (slope - s.gain * np.array([live["gx"][v, u], live["gy"][v, u]])) / s.sigma_gradient
        jacobian = np.array([[gxx, gxy], [gxy, gyy]]) @ shifts / s.sigma_gradient
        result.gradient = Term(e, jacobian, s.weight_gradient * (1 - gate))
    return result


def pixels(s, T_ml, live, model):
    """Every live pixel that meets a model pixel."""
    found = (pixel(s, T_ml, live, model, u, v) for v, u in np.ndindex(live["depth"].shape))
    return [p for p in found if p is not None]


def terms(found):
    return [t for p in found for t in (p.depth, p.colour, p.gradient) if t is not None]


def cost(s, T_ml, live, model):
    """What Gauss-Newton minimises, over the pixels that match at T_ml."""
    return sum(t.cost for t in terms(pixels(s, T_ml, live, model)))


def normal_equations(s, T_ml, live, model):
    """A [6, 6], b [6] and the statistics, by name."""
    found = pixels(s, T_ml, live, model)
    matched = [p for p in found if p.matched]
    A, b = np.zeros((6, 6)), np.zeros(6)
    for t in terms(matched):
        A += t.weight * t.robust * t.jacobian.T @ t.jacobian
        b += t.weight * t.robust * t.jacobian.T @ t.e
    depth = np.array([p.sensor_sigmas for p in matched if p.depth is not None])
    firm = [p for p in matched if p.colour is not None]
    w, m, n = np.array([(p.colour.robust, p.live, p.model) for p in firm]).reshape(-1, 3).T
    return {
        "A": A,
        "b": b,
        "candidates": len(found),
        "matched": len(matched),
        "shown": len(firm),
        "inliers": (depth < INLIER_SIGMAS).sum(),
        "depth_sum": depth.sum(),
        "colour_sum": sum(p.colour_sigmas for p in matched),
        "moments": np.array([w.sum(), w @ m, w @ n, w @ m**2, w @ (m * n)]),
    }
