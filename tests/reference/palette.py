"""Ids read back from colours of the palette: the twin of what the device reads off renderings."""

import numpy as np

from tgslam.planes.identity.palette import NO_PLANE, colours


def ids_of(observed, known_ids, margin=0.05):
    """The known id whose colour is nearest to each of the colours [N, 3] -> [N].

    -1 where black is nearer, or where another known colour (or black) is nearer than `margin` farther: undecided.
    """
    candidates = np.append(NO_PLANE, np.asarray(known_ids, np.int64)).astype(np.int32)
    squared = _squared_distances(np.asarray(observed, np.float64), colours(candidates).astype(np.float64))
    if len(candidates) == 1:
        return np.full(len(squared), NO_PLANE, np.int32)
    nearest = np.argmin(squared, axis=1)
    two = np.sqrt(np.maximum(np.partition(squared, 1, axis=1)[:, :2], 0.0))
    return np.where(two[:, 1] - two[:, 0] >= margin, candidates[nearest], NO_PLANE).astype(np.int32)


def _squared_distances(a, b):
    """[N, M] between rows of a [N, 3] and of b [M, 3]."""
    return (a**2).sum(1)[:, None] - 2.0 * a @ b.T + (b**2).sum(1)
