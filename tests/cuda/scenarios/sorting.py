"""Radix sort and prefix sums; they run under CUDA only."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.device import runtime
from tgslam.ops.sort import Pairs, PrefixSums, RadixSort


def keys_with_ties(count: int, distinct: int, seed: int = 0) -> np.ndarray:
    """[count] uint32 out of so many distinct values, of which all bits vary."""
    rng = np.random.default_rng(seed)
    return rng.choice(rng.integers(0, 1 << 32, distinct, dtype=np.uint32), count)


def values_and_order(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers to add up, and the order in which to take them."""
    rng = np.random.default_rng(1)
    return rng.integers(0, 40, count, dtype=np.int32), rng.permutation(count).astype(np.int32)


@scenario
def sorted_pairs(count: int = 300, distinct: int = 40, bits: int = 32) -> dict[str, np.ndarray]:
    """Keys and the places they came from."""
    pairs = Pairs(max(count, 1))
    if count:
        pairs.keys.from_numpy(keys_with_ties(count, distinct).view(np.int32))
        pairs.values.from_numpy(np.arange(count, dtype=np.int32))
    RadixSort()(pairs, count, bits)
    keys, values = runtime.to_host(pairs.keys)[:count], runtime.to_host(pairs.values)[:count]
    return {"keys": keys.view(np.uint32), "values": values}


@scenario
def prefix_sums(count: int = 300) -> dict[str, np.ndarray]:
    """Prefix sums and their total."""
    values, order = values_and_order(count)
    before = runtime.empty((count + 1,), np.int32)
    rows = [runtime.to_device(a if count else [0], np.int32) for a in (values, order)]
    total = PrefixSums()(*rows, count, before)
    return {"before": runtime.to_host(before), "total": np.array(total)}
