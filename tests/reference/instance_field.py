"""The instance field in float64 NumPy: E_pgi (Eq. 4), its weights, relaxation, and decoding."""

import numpy as np

from tests.reference.loss import charbonnier

EDGE_PX = 2
LOW, HIGH = 0.01, 0.99


def weights(ids, depth, config):
    """w_edge [H, W], pixel by pixel."""
    height, width = ids.shape
    out = np.zeros(ids.shape)
    for i, j in np.ndindex(ids.shape):
        if depth[i, j] <= 0:
            continue
        steps = [(y, x) for y in (-EDGE_PX, 0, EDGE_PX) for x in (-EDGE_PX, 0, EDGE_PX)]
        around = [(np.clip(i + y, 0, height - 1), np.clip(j + x, 0, width - 1)) for y, x in steps]
        edge = any(depth[at] > 0 and ids[at] != ids[i, j] for at in around)
        out[i, j] = (1.0 if ids[i, j] >= 0 else config.no_plane_weight) * (1.0 + config.edge_boost * edge)
    return out


def value(embedding, opacity, ids, weight, codes, config):
    """lambda_pgi E_pgi; ids beyond the table look like no plane."""
    wanted = codes[np.where(ids + 1 < len(codes), ids + 1, 0)]
    residual = np.linalg.norm(embedding - opacity[..., None] * wanted, axis=-1)
    counted = (weight > 0).sum()
    total = (weight * charbonnier(residual, config.expert.embedding.charbonnier_pgi)).sum()
    return config.lambda_pgi * total / counted if counted else 0.0


def relax(visible, grad_theta, curvature, counted, most_px, step, floor, share_of_most, theta):
    """New embeddings [N, 3]; curvature, most_px: [N].

    A view moves a Gaussian as if so many pixels, floor each, had shown it as it is: one, or share_of_most of the most
    that any view has shown of it.
    """
    theta = theta.copy()
    for i in np.flatnonzero(visible):
        if curvature[i] > 0:
            rests = floor / counted * max(1.0, share_of_most * most_px[i])
            colour = np.clip(1 / (1 + np.exp(-theta[i])), LOW, HIGH)
            slope = grad_theta[i] / (colour * (1 - colour))
            moved = np.clip(colour - step * slope / (curvature[i] + rests), LOW, HIGH)
            theta[i] = np.log(moved / (1 - moved))
    return theta


def read(embedding, opacity, ids, codes, margin, min_opacity):
    """The id of the nearest code [H, W], -1 where it is undecided or there is too little opacity."""
    colour = embedding / np.where(opacity > 0, opacity, 1)[..., None]
    distance = np.linalg.norm(colour[..., None, :] - codes, axis=-1)
    ordered = np.sort(distance, axis=-1)
    second = ordered[..., 1] if len(codes) > 1 else np.inf
    clear = (opacity >= min_opacity) & (second - ordered[..., 0] >= margin)
    return np.where(clear, np.asarray(ids)[distance.argmin(-1)], -1)
