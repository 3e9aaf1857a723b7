"""What views show of each Gaussian: the running record against its definition, and rows that come and go."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.kernels.objective import PIXELS, TOTALS
from tgslam.mapping.sightings import Sightings

WEIGHT = 5.0  # of the intensity term over three times its Charbonnier epsilon


def record(sightings: Sightings, visible: NDArray, curvature: NDArray, pixels: float, weight: float = WEIGHT) -> None:
    both = np.stack([curvature, np.full_like(curvature, 1e9)], axis=1)  # the depth's column must not matter
    totals = np.zeros(TOTALS)
    totals[PIXELS] = pixels
    sightings.record(runtime.to_device(visible, np.int32), runtime.to_device(both), runtime.to_device(totals), weight)


def test_the_most_of_any_view_is_kept_and_only_views_in_sight_count() -> None:
    rng = np.random.default_rng(0)
    sightings, n = Sightings(), 200
    sightings.append(n)
    contribution, views = np.zeros(n), np.zeros(n, int)
    for _ in range(5):
        visible, pixels = rng.integers(0, 3, n), rng.uniform(10, 1000)
        curvature = rng.exponential(size=n)
        record(sightings, visible, curvature, pixels)
        contribution = np.where(visible > 0, np.maximum(contribution, curvature * pixels / WEIGHT), contribution)
        views += visible > 0
    np.testing.assert_allclose(sightings.contribution, contribution, rtol=1e-5)
    np.testing.assert_array_equal(sightings.views, views)


def test_a_view_without_pixels_leaves_finite_numbers() -> None:
    sightings = Sightings()
    sightings.append(3)
    record(sightings, np.ones(3), np.zeros(3), 0.0)
    np.testing.assert_array_equal(sightings.contribution, 0.0)
    np.testing.assert_array_equal(sightings.views, 1)


def test_a_loss_without_an_intensity_term_finds_everything_in_sight_useful() -> None:
    sightings = Sightings()
    sightings.append(2)
    record(sightings, np.array([1, 0]), np.zeros(2), 100.0, weight=0.0)
    assert sightings.contribution[0] > 1e6
    assert sightings.contribution[1] == 0.0


def test_rows_keep_their_record_when_others_come_and_go() -> None:
    sightings = Sightings()
    sightings.append(70)
    record(sightings, np.ones(70), np.arange(70.0), WEIGHT)
    kept = np.arange(70) % 3 == 1
    sightings.keep(kept)
    sightings.append(1000)  # beyond the capacity
    assert sightings.rows == 1000 + kept.sum()
    np.testing.assert_array_equal(sightings.contribution[: kept.sum()], np.arange(70.0)[kept])
    assert (sightings.views[: kept.sum()] == 1).all()
    assert not sightings.contribution[kept.sum() :].any() and not sightings.views[kept.sum() :].any()
    sightings.keep(np.zeros(sightings.rows, bool))
    assert len(sightings.views) == len(sightings.contribution) == 0
