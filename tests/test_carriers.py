"""Which keyframes Gaussians follow: fair samples of what their places were averaged from."""

from __future__ import annotations

import numpy as np

from tgslam.mapping.carriers import Carriers


def carriers(rows: int, seed: int = 0) -> Carriers:
    """Rows that the keyframe 0 has seeded."""
    result = Carriers(np.random.default_rng(seed))
    result.append(np.zeros(rows, np.int32))
    return result


def test_each_keyframe_is_held_as_often_as_its_weight_has_it() -> None:
    """Weights 1, 1, 2, 4: what the fusion of depth would have made of them, by its gains."""
    weights, shares = np.array([1.0, 1.0, 2.0, 4.0]), np.zeros(4)
    for seed in range(500):
        sample = carriers(2, seed)
        for k in range(1, 4):
            sample.learn(np.array([1]), k, np.array([weights[k] / weights[: k + 1].sum()]))
        assert (sample.keyframes[0] == 0).all()
        shares += np.bincount(sample.keyframes[1], minlength=4) / sample.keyframes.shape[1] / 500
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.02)


def test_a_draw_takes_a_share_of_the_slots_within_one() -> None:
    gain = np.linspace(0.0, 1.0, 41)
    sample = carriers(len(gain))
    sample.learn(np.arange(len(gain)), 1, gain)
    slots = sample.keyframes.shape[1]
    assert (np.abs((sample.keyframes == 1).sum(axis=1) - slots * gain) < 1.0).all()


def test_rows_with_one_history_have_the_same_carriers() -> None:
    """So that neighbours move alike."""
    sample, rng = carriers(10), np.random.default_rng(1)
    for k in range(1, 30):
        sample.learn(np.arange(10), k, np.full(10, rng.random()))
    assert (sample.keyframes == sample.keyframes[0]).all()


def test_rows_come_and_go() -> None:
    sample = carriers(3)
    sample.learn(np.array([2]), 5, np.array([1.0]))
    sample.append(sample.keyframes[[2, 0]])
    sample.append(np.array([7], np.int32))
    sample.keep(np.array([False, True, True, True, True, True]))
    assert [set(row) for row in sample.keyframes.tolist()] == [{0}, {5}, {5}, {0}, {7}]
    assert sample.keyframes.dtype == np.int32
