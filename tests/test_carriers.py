"""Which keyframes Gaussians follow: fair samples of what their places were averaged from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.map.gaussians import CARRIERS
from tgslam.mapping.carriers import CarrierDraw


def seeded(rows: int) -> NDArray[np.int32]:
    """Rows that the keyframe 0 has seeded."""
    return np.zeros((rows, CARRIERS), np.int32)


def test_each_keyframe_is_held_as_often_as_its_weight_has_it() -> None:
    """Weights 1, 1, 2, 4: what the fusion of depth would have made of them, by its gains."""
    weights, shares = np.array([1.0, 1.0, 2.0, 4.0]), np.zeros(4)
    for seed in range(500):
        draw, sample = CarrierDraw(np.random.default_rng(seed)), seeded(1)
        for k in range(1, 4):
            sample = draw(sample, k, np.array([weights[k] / weights[: k + 1].sum()]))
        shares += np.bincount(sample[0], minlength=4) / CARRIERS / 500
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.02)


def test_a_draw_takes_a_share_of_the_slots_within_one_and_changes_nothing_given() -> None:
    gain, before = np.linspace(0.0, 1.0, 41), seeded(41)
    sample = CarrierDraw(np.random.default_rng(0))(before, 1, gain)
    assert (np.abs((sample == 1).sum(axis=1) - CARRIERS * gain) < 1.0).all()
    assert not before.any()
    assert sample.dtype == np.int32


def test_rows_with_one_history_have_the_same_carriers() -> None:
    """So that neighbours move alike."""
    draw, sample, rng = CarrierDraw(np.random.default_rng(0)), seeded(10), np.random.default_rng(1)
    for k in range(1, 30):
        sample = draw(sample, k, np.full(10, rng.random()))
    assert (sample == sample[0]).all()
