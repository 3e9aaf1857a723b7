"""How well predicted instances are the true ones, counted in pixels of id images over one frame or a whole sequence.

A true instance is one label, a predicted one is one id; negative values are neither. Instances have to be large enough
to count. Other labels are void: what is predicted on their pixels is neither right nor wrong. Other ids are taken as no
prediction: where colours blend into each other, a few pixels read as anything.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import EvaluationError

IdImage = NDArray[np.int32]
Overlaps = Mapping[tuple[int, int], int]  # (true label, predicted id) -> pixels

_MATCH_IOU = 0.5  # above it at most one prediction fits a label, and one label a prediction
SHOWN_SHARE = 0.002  # of the image that an instance covers: less is a scrap
IDENTITY_SHARE = 0.25  # of a label's pixels that an id covers: less is no identity


@dataclass(frozen=True)
class PanopticScore:
    """Panoptic quality and its parts; None where there is nothing to divide by."""

    quality: float | None  # sum of the matches' IoU / (TP + FP / 2 + FN / 2)
    mean_iou: float | None  # of the matches
    precision: float | None  # share of the predicted instances that match
    recall: float | None  # share of the true instances that match
    matches: dict[int, int]  # true label -> predicted id


def overlaps(labels: IdImage, ids: IdImage) -> Counter[tuple[int, int]]:
    """Pixels by pair of true label and predicted id, for images [H, W]. Raises EvaluationError for unequal sizes."""
    if labels.shape != ids.shape:
        raise EvaluationError(f"the id image is {ids.shape}, but the labels are {labels.shape}")
    pairs, pixels = np.unique(np.stack([labels.ravel(), ids.ravel()]), axis=1, return_counts=True)
    return Counter({(int(label), int(id_)): int(n) for label, id_, n in zip(*pairs, pixels, strict=True)})


def shown(pixels: Overlaps) -> tuple[frozenset[int], frozenset[int]]:
    """The labels and the ids that cover enough of one frame to be instances in it."""
    least = SHOWN_SHARE * sum(pixels.values())
    sizes: tuple[Counter[int], Counter[int]] = Counter(), Counter()
    for pair, count in pixels.items():
        for size, value in zip(sizes, pair, strict=True):
            size[value] += count
    labels, ids = (frozenset(v for v, count in size.items() if v >= 0 and count >= least) for size in sizes)
    return labels, ids


def panoptic(
    pixels: Overlaps, labels: Collection[int], ids: Collection[int], minor_ids: Collection[int] = ()
) -> PanopticScore:
    """The score of one frame, or of the sum of several: then an instance is all its pixels of all frames.

    labels, ids: the instances that count. A prediction that lies for more than half on void is no false one; neither is
    one of minor_ids, which are as small as the labels that do not count.
    """
    true_px: Counter[int] = Counter()
    predicted_px: Counter[int] = Counter()
    void_px: Counter[int] = Counter()
    for (label, id_), count in pixels.items():
        if label >= 0 and label not in labels:
            void_px[id_] += count
            continue
        true_px[label] += count
        predicted_px[id_] += count
    true = {label for label in true_px if label >= 0}
    ious = {
        (label, id_): count / (true_px[label] + predicted_px[id_] - count)
        for (label, id_), count in pixels.items()
        if label in true and id_ in ids
    }
    matched = {pair: iou for pair, iou in ious.items() if iou > _MATCH_IOU}
    judged = {id_ for id_ in predicted_px if id_ in ids and predicted_px[id_] >= void_px[id_] and id_ not in minor_ids}
    judged |= {id_ for _, id_ in matched}
    total = float(sum(matched.values()))
    return PanopticScore(
        quality=_ratio(2.0 * total, len(true) + len(judged)),
        mean_iou=_ratio(total, len(matched)),
        precision=_ratio(len(matched), len(judged)),
        recall=_ratio(len(matched), len(true)),
        matches=dict(sorted(matched)),
    )


class IdentitySwitches:
    """Counts how often true instances change their predicted id from one frame that shows them to the next.

    The id of a true instance in a frame is the one that covers most of it, if it is enough to speak of. Changing there
    and back are two switches; of an instance that is split, each change of the larger part is one.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.switches = 0
        self._latest: dict[int, int] = {}

    def add(self, pixels: Overlaps, labels: Collection[int]) -> None:
        """Take the overlaps of the next frame, and the labels that count in it."""
        self.frames += 1
        for label in labels:
            identity = _identity({id_: count for (other, id_), count in pixels.items() if other == label})
            if identity is not None:
                self.switches += self._latest.get(label, identity) != identity
                self._latest[label] = identity

    @property
    def per_100_frames(self) -> float | None:
        """None before the first frame."""
        return _ratio(100.0 * self.switches, self.frames)


def _identity(pixels: Mapping[int, int]) -> int | None:
    """The id of a label that shows these pixels by predicted id; of equals, the smaller one."""
    known = {id_: count for id_, count in pixels.items() if id_ >= 0}
    if not known:
        return None
    best = min(known, key=lambda id_: (-known[id_], id_))
    return best if known[best] >= IDENTITY_SHARE * sum(pixels.values()) else None


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None
