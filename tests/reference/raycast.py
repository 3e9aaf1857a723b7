"""NumPy float64 twin of kernels/raycast.py and kernels/procedural.py: whole images at once, every primitive tested."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import map_coordinates

from tgslam.kernels import procedural as kinds
from tgslam.kernels.raycast import BOX, CYLINDER, ELLIPSOID, LAYER_LEAD, QUAD

NO_HIT = 1e30


@dataclass(frozen=True)
class Hit:
    depth_m: np.ndarray  # [...]
    primitive: np.ndarray  # [...] int
    label: np.ndarray  # [...] int
    cosine: np.ndarray  # [...]
    colour: np.ndarray  # [..., 3]


def cast(scene, material_kind, material, occlusion, rays, fx, fy):
    """What the rays [..., 3] (x, y, 1) meet. scene: CameraScene; the arrays as in kernels.raycast.shade."""
    shape = rays.shape[:-1]
    rays = rays.reshape(-1, 3)
    best_key = np.full(len(rays), NO_HIT)
    depth, primitive = np.zeros(len(rays)), np.full(len(rays), -1)
    for i, (kind, _, _, layer) in enumerate(scene.meta):
        low, high = interval(kind, scene.origin[i], rays @ scene.axes[i].T, scene.half_m[i])
        key = low * (1 - LAYER_LEAD * layer)
        wins = (low <= high) & (low > 0) & (key < best_key)
        best_key[wins], depth[wins], primitive[wins] = key[wins], low[wins], i
    label, cosine = np.full(len(rays), -1), np.zeros(len(rays))
    colour = np.tile([0.55, 0.62, 0.7], (len(rays), 1))
    for i in np.unique(primitive[primitive >= 0]):
        mask = primitive == i
        surface = Surface(scene, i, depth[mask], rays[mask], fx, fy)
        label[mask], cosine[mask] = surface.label(), surface.cosine()
        row = scene.meta[i, 1]
        colour[mask] = np.clip(
            surface.lit(material_kind[row], material[row].astype(float), scene.light, occlusion), 0, 1
        )
    return Hit(*(a.reshape(*shape, *a.shape[1:]) for a in (depth, primitive, label, cosine, colour)))


def interval(kind, o, d, half):
    """Entry and exit t [K] of rays o + t d, o [3], d [K, 3] in the primitive's frame."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if kind == QUAD:
            t = -o[2] / d[:, 2]
            inside = (np.abs(o[0] + t * d[:, 0]) <= half[0]) & (np.abs(o[1] + t * d[:, 1]) <= half[1])
            return np.where(inside, t, NO_HIT), np.where(inside, t, -NO_HIT)
        slabs = [np.sort([(-half[k] - o[k]) / d[:, k], (half[k] - o[k]) / d[:, k]], axis=0) for k in range(3)]
        if kind == BOX:
            return np.max([s[0] for s in slabs], axis=0), np.min([s[1] for s in slabs], axis=0)
        if kind == ELLIPSOID:
            return quadratic(o / half, d / half)
        low, high = quadratic(o[:2] / half[:2], d[:, :2] / half[:2])
        return np.maximum(low, slabs[2][0]), np.minimum(high, slabs[2][1])


def quadratic(o, d):
    """Both roots of |o + t d|^2 = 1."""
    a, b, c = (d * d).sum(1), d @ o, o @ o - 1
    root = b * b - a * c
    reach = np.sqrt(np.maximum(root, 0))
    return np.where(root > 0, (-b - reach) / a, NO_HIT), np.where(root > 0, (-b + reach) / a, -NO_HIT)


class Surface:
    """The points where rays meet one primitive, in its local frame."""

    def __init__(self, scene, i, t, rays, fx, fy):
        self.shape, _, self.first, _ = scene.meta[i]
        self.axes, self.half = scene.axes[i], scene.half_m[i]
        self.t, self.rays, self.focal = t, rays, (fx, fy)
        self.d = rays @ self.axes.T
        self.p = scene.origin[i] + t[:, None] * self.d
        self.axis = self._axis()
        self.n = self._normal()

    def _axis(self):
        p, half = np.abs(self.p), self.half
        if self.shape == QUAD:
            return np.full(len(p), 2)
        if self.shape == BOX:
            return np.argmax(p - half, axis=1)
        if self.shape == CYLINDER:
            radial = np.hypot(self.p[:, 0] / half[0], self.p[:, 1] / half[1])
            return np.where(p[:, 2] - half[2] > (radial - 1) * half[0], 2, -1)
        return np.full(len(p), -1)

    def _normal(self):
        if self.shape == QUAD:
            return np.tile([0.0, 0.0, 1.0], (len(self.p), 1))
        flat = np.eye(3)[self.axis] * np.where(self.p > 0, 1.0, -1.0)
        gradient = self.p / self.half**2
        if self.shape == CYLINDER:
            gradient[:, 2] = 0
        gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
        return np.where((self.axis >= 0)[:, None], flat, gradient)

    def label(self):
        if self.shape == QUAD:
            return np.full(len(self.p), self.first)
        side = np.take_along_axis(self.p, np.maximum(self.axis, 0)[:, None], axis=1)[:, 0] > 0
        face = self.first + (2 * self.axis if self.shape == BOX else 0) + side
        return np.where(self.axis >= 0, face, -1)

    def cosine(self):
        return np.abs((self.n * self.d).sum(1)) / np.linalg.norm(self.rays, axis=1)

    def coordinates(self):
        """(s, t), half sizes and footprint, each [K, 2], and the distance to the nearest edge [K], all m."""
        toward = np.where((self.n * self.d).sum(1) > 0, -1.0, 1.0)[:, None]
        n = self.n = self.n * toward
        approach = np.minimum((n * self.d).sum(1), -0.03 * np.linalg.norm(self.rays, axis=1))[:, None]
        motions = []
        for k in range(2):
            step = self.axes[:, k] / self.focal[k]
            motions.append(self.t[:, None] * (step - self.d * (n @ step)[:, None] / approach))
        spread = np.abs(motions[0]) + np.abs(motions[1])
        pairs = {0: (1, 2), 1: (0, 2), 2: (0, 1), -1: (0, 1)}
        st, half, width = (np.empty((len(self.p), 2)) for _ in range(3))
        for axis, pair in pairs.items():
            mask = np.ix_(self.axis == axis, pair)
            rows = self.axis == axis
            st[rows], half[rows], width[rows] = self.p[mask], self.half[list(pair)], spread[mask]
        curved = self.axis < 0
        if self.shape == CYLINDER:
            p = self.p[curved]
            st[curved] = np.column_stack([np.arctan2(p[:, 1], p[:, 0]) * self.half[0], p[:, 2]])
            half[curved] = (np.pi * self.half[0], self.half[2])
            along = np.column_stack([-n[curved, 1], n[curved, 0], np.zeros(curved.sum())])
            turn = sum(np.abs((m[curved] * along).sum(1)) for m in motions)
            width[curved] = np.column_stack([turn, spread[curved, 2]])
        elif self.shape == ELLIPSOID:
            st = self.p[:, :2] + self.p[:, 2:] * [0.5, -0.4]
            width = spread[:, :2] + spread[:, 2:]
        return st, half, width, np.maximum((half - np.abs(st)).min(1), 0)

    def lit(self, kind_seed, material, light, occlusion):
        st, half, width, edge = self.coordinates()
        albedo = surface_colour(*kind_seed, material, st, half, width)
        n = self.n @ self.axes
        to_lamp = light[2, :3] - self.t[:, None] * self.rays
        distance = np.maximum(np.linalg.norm(to_lamp, axis=1), 0.05)
        lamp = np.maximum((n * to_lamp).sum(1) / distance, 0) / (1 + 0.08 * distance**2)
        level = light[0, 3] * (1 + 0.15 * n @ light[0, :3]) + light[1, 3] * (0.5 + 0.5 * n @ light[1, :3])
        level = level + light[2, 3] * lamp
        ahead = self.t[:, None] * self.rays + 0.09 * n
        grid = (light[3:, :3] @ ahead.T + light[3:, 3:])[::-1]
        level = level * (1 - 0.9 * map_coordinates(occlusion.astype(float), grid, order=1, mode="nearest"))
        shade = np.where(self.axis >= 0, material[9], 0.0)
        return albedo * (level * (1 - shade * np.exp(-edge / 0.2)))[:, None]


def lattice_hash(i, j, seed):
    def word(x):
        return np.asarray(x).astype(np.int64).astype(np.uint32)

    with np.errstate(over="ignore"):
        h = word(i) * np.uint32(1640531513) + word(j) * np.uint32(1013904223) + word(seed) * np.uint32(1597334677)
        h = (h ^ (h >> np.uint32(16))) * np.uint32(2057459429)
        h = (h ^ (h >> np.uint32(13))) * np.uint32(1274126177)
        h = h ^ (h >> np.uint32(16))
    return (h >> np.uint32(8)) / 2.0**24


def corners(i, j, ws, wt, seed):
    low = lattice_hash(i, j, seed) * (1 - ws) + lattice_hash(i + 1, j, seed) * ws
    high = lattice_hash(i, j + 1, seed) * (1 - ws) + lattice_hash(i + 1, j + 1, seed) * ws
    return low * (1 - wt) + high * wt


def octaves(s, t, width, seed):
    total = np.zeros_like(s)
    for octave in range(4):
        x, y = s * 2**octave, t * 2**octave
        i, j = np.floor(x), np.floor(y)
        wx, wy = ((f * f * (3 - 2 * f)) for f in (x - i, y - j))
        fade = np.clip(2 - 2 * width * 2**octave, 0, 1)
        total += 0.55**octave * fade * (corners(i, j, wx, wy, seed + octave) - 0.5)
    return total


def blend_weight(fraction, width):
    return np.clip((fraction - 0.5) / np.clip(width, 1e-3, 1) + 0.5, 0, 1)


def cells(s, t, ws, wt, seed):
    i, j = np.floor(s - 0.5), np.floor(t - 0.5)
    value = corners(i, j, blend_weight(s - 0.5 - i, ws), blend_weight(t - 0.5 - j, wt), seed)
    return 0.5 + np.clip(2 - np.maximum(ws, wt), 0, 1) * (value - 0.5)


def cells_along(s, ws, seed):
    i = np.floor(s - 0.5)
    blend = blend_weight(s - 0.5 - i, ws)
    value = lattice_hash(i, 0, seed) * (1 - blend) + lattice_hash(i + 1, 0, seed) * blend
    return 0.5 + np.clip(2 - ws, 0, 1) * (value - 0.5)


def pulse(x, width, duty):
    def integral(v):
        return np.floor(v) * duty + np.minimum(v - np.floor(v), duty)

    w = np.maximum(width, 4e-3)
    return (integral(x + w / 2) - integral(x - w / 2)) / w


def planks(s, t, ws, wt, seed):
    j = np.floor(t - 0.5)
    blend = blend_weight(t - 0.5 - j, wt)
    tint, joint = 0.0, 0.0
    for row, share in ((j, 1 - blend), (j + 1, blend)):
        x = s + lattice_hash(row, 17, seed)
        tint = tint + share * cells_along(x, ws, seed + 31 * row)
        joint = joint + share * pulse(x + 0.0175, ws, 0.3 * 0.035)
    return tint, 1 - (1 - joint) * (1 - pulse(t + 0.0175, wt, 0.035))


def mix(a, b, share):
    return a * (1 - share)[:, None] + b * share[:, None]


def books(s, t01, ws, wt, seed, a, b):
    tints = np.stack([cells_along(s, ws, seed + c) for c in range(3)], axis=1)
    colour = (a * (1 - tints) + b * tints) * (0.55 + 0.9 * tints)
    soft = np.maximum(wt, 0.01)
    band_at = 0.35 + 0.25 * cells_along(s, ws, seed + 11)
    band = 0.6 * np.clip(0.5 + (0.06 - np.abs(t01 - band_at)) / soft, 0, 1)
    colour = mix(colour, np.array([0.85, 0.8, 0.6]), band)
    above = np.clip(0.5 + (t01 - 0.72 - 0.25 * cells_along(s, ws, seed + 7)) / soft, 0, 1)
    return colour * ((1 - 0.7 * pulse(s + 0.04, ws, 0.08)) * (1 - 0.85 * above))[:, None]


def picture(st, w, scale, seed, a, contrast):
    s, t = st.T
    channels = []
    for c in range(3):
        blocks = cells(s / scale, t / (0.7 * scale), w / scale, w / (0.7 * scale), seed + c) - 0.5
        clouds = octaves(s / (2 * scale), t / (2 * scale), w / (2 * scale), seed + 40 + c)
        channels.append(a[c] + contrast * (0.6 * blocks + 0.6 * clouds))
    return np.stack(channels, axis=1)


def surface_colour(kind, seed, material, st, half, width):
    """Albedo [K, 3] at (s, t) m [K, 2]."""
    a, b, (scale_s, scale_t, contrast) = material[:3], material[3:6], material[6:9]
    s, t = (st / [scale_s, scale_t]).T
    ws, wt = (width / [scale_s, scale_t]).T
    widest = np.maximum(ws, wt)
    if kind == kinds.PLAIN:
        return a * (1 + contrast * octaves(s, t, widest, seed))[:, None]
    if kind == kinds.CLOUD:
        return mix(a, b, np.clip(0.5 + contrast * octaves(s, t, widest, seed), 0, 1))
    if kind == kinds.TILES:
        tint = contrast * (cells(s, t, ws, wt, seed) - 0.5) + 0.12 * octaves(3 * s, 3 * t, 3 * widest, seed + 5)
        joint = 1 - (1 - pulse(s, ws, 0.035)) * (1 - pulse(t, wt, 0.035))
        return mix(a * (1 + tint)[:, None], b, joint)
    if kind == kinds.PLANKS:
        tint, joint = planks(s, t, ws, wt, seed)
        grain = octaves(4 * s, 3 * t, np.maximum(4 * ws, 3 * wt), seed + 5)
        share = np.clip(0.5 + contrast * (tint - 0.5 + 0.5 * grain), 0, 1)
        return mix(a, b, share) * (1 - 0.5 * joint)[:, None]
    if kind == kinds.BOOKS:
        tall = 2 * half[:, 1]
        return books(s, 0.5 + st[:, 1] / tall, ws, width[:, 1] / tall, seed, a, b)
    if kind == kinds.PICTURE:
        w = width.max(1)
        inside = np.clip(0.5 + ((half - np.abs(st)).min(1) - 0.035) / np.maximum(w, 1e-3), 0, 1)
        return mix(b, picture(st, w, scale_s, seed, a, contrast), inside)
    stripes = pulse(s, ws, 0.5) + pulse(t, wt, 0.5) - 1
    grain = octaves(0.7 * s, 0.7 * t, 0.7 * widest, seed)
    return mix(a, b, np.clip(0.5 + contrast * (0.5 * stripes + 0.8 * grain), 0, 1))


def render(scene, material_kind, material, occlusion, camera):
    """Twin of `cast` then `shade`: the Hit of the pixel centres, with colour the mean of 2 x 2 rays along edges."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))

    def at(du, dv):
        rays = np.stack([(u + du - camera.cx) / camera.fx, (v + dv - camera.cy) / camera.fy, np.ones(u.shape)], -1)
        return cast(scene, material_kind, material, occlusion, rays, camera.fx, camera.fy)

    centre = at(0, 0)
    surface = np.pad(np.stack([centre.primitive, centre.label]), ((0, 0), (1, 1), (1, 1)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(surface, (3, 3), axis=(1, 2))
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], bool)
    edge = ((windows != windows[..., 1:2, 1:2]) & cross).any(axis=(0, 3, 4))
    fine = np.mean([at(du, dv).colour for du in (-0.25, 0.25) for dv in (-0.25, 0.25)], axis=0)
    return replace(centre, colour=np.where(edge[..., None], fine, centre.colour))
