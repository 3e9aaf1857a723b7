"""What views show of each Gaussian: the running record against its definition."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.kernels.objective import PIXELS, TOTALS
from tgslam.ops import rows

WEIGHT = 5.0  # of the intensity term over three times its Charbonnier epsilon


class Record:
    """Of some rows."""

    def __init__(self, count: int) -> None:
        self.contribution, self.views = runtime.zeros((count,)), runtime.zeros((count,), np.int32)

    def take(self, visible: NDArray, curvature: NDArray, pixels: float, weight: float = WEIGHT) -> None:
        both = np.stack([curvature, np.full_like(curvature, 1e9)], axis=1)  # the depth's column must not matter
        totals = np.zeros(TOTALS)
        totals[PIXELS] = pixels
        rows.record_view(
            len(visible), runtime.to_device(visible, np.int32), runtime.to_device(both), runtime.to_device(totals),
            weight, self.contribution, self.views,
        )  # fmt: skip


def test_the_most_of_any_view_is_kept_and_only_views_in_sight_count() -> None:
    rng = np.random.default_rng(0)
    n = 200
    record, contribution, views = Record(n), np.zeros(n), np.zeros(n, int)
    for _ in range(5):
        visible, pixels = rng.integers(0, 3, n), rng.uniform(10, 1000)
        curvature = rng.exponential(size=n)
        record.take(visible, curvature, pixels)
        contribution = np.where(visible > 0, np.maximum(contribution, curvature * pixels / WEIGHT), contribution)
        views += visible > 0
    np.testing.assert_allclose(record.contribution, contribution, rtol=1e-5)
    np.testing.assert_array_equal(record.views, views)


def test_a_view_without_pixels_leaves_finite_numbers() -> None:
    record = Record(3)
    record.take(np.ones(3), np.zeros(3), 0.0)
    np.testing.assert_array_equal(record.contribution, 0.0)
    np.testing.assert_array_equal(record.views, 1)


def test_a_loss_without_an_intensity_term_finds_everything_in_sight_useful() -> None:
    record = Record(2)
    record.take(np.array([1, 0]), np.zeros(2), 100.0, weight=0.0)
    assert record.contribution[0] > 1e6
    assert record.contribution[1] == 0.0
