"""Radix sort and prefix sums under CUDA against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cuda.harness import GRIDS, Devices
from tests.cuda.scenarios import sorting
from tools.cudacheck.environment import Grid

pytestmark = [pytest.mark.cuda_check, pytest.mark.parametrize("grid", GRIDS)]

SIZES = (0, 1, 31, 255, 256, 257, 5000, 70_000)  # the last takes chunks of more than a block


@pytest.mark.parametrize("count", SIZES)
def test_sort_is_stable_and_uses_every_bit(devices: Devices, grid: Grid, count: int) -> None:
    distinct = max(1, count // 8)
    found = devices.cuda(sorting.sorted_pairs, grid, count=count, distinct=distinct)
    keys = sorting.keys_with_ties(count, distinct)
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(found["values"], order)
    np.testing.assert_array_equal(found["keys"], keys[order])


@pytest.mark.parametrize("bits", [1, 8, 11, 16])
def test_sort_by_the_lowest_digits(devices: Devices, grid: Grid, bits: int) -> None:
    """Whole digits count: keys that have no bits beyond `bits` come out sorted."""
    found = devices.cuda(sorting.sorted_pairs, grid, count=600, distinct=50, bits=bits)
    digits = -(-bits // 8) * 8
    keys = sorting.keys_with_ties(600, 50) & np.uint32((1 << digits) - 1)
    np.testing.assert_array_equal(found["values"], np.argsort(keys, kind="stable"))


def test_equal_keys_keep_their_order(devices: Devices, grid: Grid) -> None:
    found = devices.cuda(sorting.sorted_pairs, grid, count=3000, distinct=1)
    np.testing.assert_array_equal(found["values"], np.arange(3000))


@pytest.mark.parametrize("count", SIZES)
def test_prefix_sums(devices: Devices, grid: Grid, count: int) -> None:
    found = devices.cuda(sorting.prefix_sums, grid, count=count)
    values, order = sorting.values_and_order(count)
    expected = np.concatenate([[0], np.cumsum(values[order])])
    np.testing.assert_array_equal(found["before"], expected)
    assert found["total"] == expected[-1]
