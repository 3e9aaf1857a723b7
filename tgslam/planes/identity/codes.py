"""How the identity of a plane is rendered: as a colour of the palette (Eq. 2), or as a scalar, for comparison."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.config.plane_settings import StructureConfig
from tgslam.ops import instance_field
from tgslam.planes.identity import palette

_NEAR_MARGINS = 2.0  # of reading: so near has to be a mixture, each end of which may be off by one
_NEUTRAL = 0.5  # what embeddings of 0 show: channels that carry nothing never move


def codes_of(ids: ArrayLike, config: StructureConfig) -> NDArray[np.float32]:
    """What ids of any shape [...] look like when they are rendered, [..., 3] in [0, 1].

    identity: colour gives the palette's colours, black for -1. identity: scalar gives the id itself in the first
    channel, scaled so that -1 and scalar_ids - 1 are the least and the most that a sigmoid (Eq. 1) reaches; larger ids
    look alike.
    """
    if config.identity == "colour":
        return palette.colours(ids)
    steps = np.clip((np.asarray(ids, np.float64) + 1.0) / config.expert.embedding.scalar_ids, 0.0, 1.0)
    first = palette.LEAST + (palette.MOST - palette.LEAST) * steps
    return np.stack([first, np.full_like(first, _NEUTRAL), np.full_like(first, _NEUTRAL)], axis=-1).astype(np.float32)


def code_table(ids: NDArray[np.integer], config: StructureConfig) -> NDArray[np.float32]:
    """[P + 1, 3] the table of `instance_field` in which plane k looks like ids[k] [P], -1 = like no plane."""
    return codes_of(np.append(palette.NO_PLANE, ids), config)


def initial_theta(plane_ids: NDArray[np.integer], config: StructureConfig) -> NDArray[np.float32]:
    """Embeddings [N, 3] of new Gaussians on these planes [N], -1 = on none: they are born with the right code."""
    return instance_field.theta_of(codes_of(plane_ids, config))


def read_ids(
    embedding: np.ndarray, opacity: np.ndarray, known_ids: ArrayLike, config: StructureConfig
) -> NDArray[np.int32]:
    """The known id that each pixel of a rendering shows, [H, W], -1 = none; see `instance_field.read_ids`.

    The nearest code is the rounded scalar where ids are scalars; the margin then is that share of a step.
    """
    ids = np.append(palette.NO_PLANE, np.asarray(known_ids, np.int64))
    min_opacity = config.expert.reading.read_opacity
    return instance_field.read_ids(embedding, opacity, ids, codes_of(ids, config), _margin(config), min_opacity)


def unmixed(colours: NDArray[np.floating], ids: NDArray[np.integer], config: StructureConfig) -> NDArray[np.int32]:
    """The larger part of the mixture of two ids that comes nearest to each of the colours [N, 3], out of ids [N, K].

    -1 = no plane, which may be a part as well. A mixture has to come within twice the margin of reading.
    """
    code = codes_of(ids, config)
    first, second = np.triu_indices(ids.shape[1])
    ends = code[:, second] - code[:, first]  # [N, pairs, 3]
    rest = colours[:, None] - code[:, first]
    share = np.clip((rest * ends).sum(-1) / np.maximum((ends**2).sum(-1), 1e-9), 0.0, 1.0)
    distance = np.linalg.norm(rest - share[..., None] * ends, axis=-1)
    rows = np.arange(len(ids))
    best = np.argmin(distance, axis=1)
    larger = np.where(share[rows, best] > 0.5, second[best], first[best])
    near = distance[rows, best] <= _NEAR_MARGINS * _margin(config)
    return np.where(near, ids[rows, larger], palette.NO_PLANE).astype(np.int32)


def _margin(config: StructureConfig) -> float:
    if config.identity == "colour":
        return config.expert.reading.read_margin
    return config.expert.reading.read_margin * (palette.MOST - palette.LEAST) / config.expert.embedding.scalar_ids
