"""Sorting and prefix sums on a CUDA device: the kernels with their scratch memory. The host only launches."""

from __future__ import annotations

import numpy as np

from tgslam.device import runtime
from tgslam.kernels.cuda import scan, sort
from tgslam.kernels.cuda.block import CHUNKS, chunk_length, chunks_of


class Pairs:
    """Keys with a payload: `keys` and `values` are [capacity] int32 device arrays that sorting exchanges for others."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.keys = runtime.empty((capacity,), np.int32)
        self.values = runtime.empty((capacity,), np.int32)
        self.spare_keys = runtime.empty((capacity,), np.int32)
        self.spare_values = runtime.empty((capacity,), np.int32)

    def exchange(self) -> None:
        """Make the spare arrays the current ones."""
        self.keys, self.spare_keys = self.spare_keys, self.keys
        self.values, self.spare_values = self.spare_values, self.values


class RadixSort:
    """Stable sort of `Pairs` by their keys, which count as unsigned."""

    def __init__(self) -> None:
        self._counts = runtime.empty((sort.DIGITS, CHUNKS), np.int32)
        self._totals = runtime.empty((sort.DIGITS,), np.int32)

    def __call__(self, pairs: Pairs, count: int, bits: int) -> None:
        """Sort the first `count` pairs by the lowest `bits` bits of their keys."""
        chunk, chunks = chunk_length(count), chunks_of(count)
        for shift in range(0, bits, sort.DIGIT_BITS):
            sort.count_digits(count, chunk, chunks, shift, pairs.keys, self._counts)
            sort.scan_digits(chunks, self._counts, self._totals)
            sort.scatter(
                count, chunk, chunks, shift, pairs.keys, pairs.values, self._counts, self._totals,
                pairs.spare_keys, pairs.spare_values,
            )  # fmt: skip
            pairs.exchange()


class PrefixSums:
    """Exclusive prefix sums of integers taken in a given order."""

    def __init__(self) -> None:
        self._sums = runtime.empty((CHUNKS,), np.int32)

    def __call__(self, values: np.ndarray, index: np.ndarray, count: int, before: np.ndarray) -> int:
        """before[k] = sum of values[index[j]] over j < k, for k = 0 ... count; returns before[count].

        All are int32 device arrays: values [N], index [count], before [count + 1]. Waits for the device.
        """
        chunk, chunks = chunk_length(count), chunks_of(count)
        scan.sum_chunks(count, chunk, chunks, values, index, self._sums)
        scan.prefix_sums(count, chunk, chunks, values, index, self._sums, before)
        return int(scan.entry(before, count))
