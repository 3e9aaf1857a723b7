"""Kernels with one mistake each, and one without: what the CUDA check must report, and must not.

What a thread writes to shared memory and reads again with the same index, Taichi 1.7.4 keeps in a register even across
a barrier; so these kernels read with another index than they write.
"""

from collections.abc import Callable

import numpy as np
import taichi as ti

from tests.cuda.harness import scenario
from tgslam.device import runtime

N, BLOCK = 1024, 128  # an array of N floats is a whole page: what lies beyond is out of bounds
F1 = ti.types.ndarray(ti.f32, ndim=1)


def _run(kernel: Callable[..., None], *arguments: int) -> dict[str, np.ndarray]:
    x, y = runtime.to_device(np.arange(N)), runtime.zeros((N,))
    kernel(x, y, *arguments)
    return {"y": runtime.to_host(y)}


@scenario
def correct() -> dict[str, np.ndarray]:
    """Each block's sum by a tree in shared memory, the work of several blocks done by one where there are few."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        ti.loop_config(block_dim=BLOCK)
        for i in range(N):
            t = i % BLOCK
            shared = ti.simt.block.SharedArray((BLOCK,), ti.f32)
            shared[t] = x[i]
            ti.simt.block.sync()
            for k in ti.static((64, 32, 16, 8, 4, 2, 1)):
                if t < k:
                    shared[t] += shared[t + k]
                ti.simt.block.sync()
            y[i] = shared[0]
            ti.simt.block.sync()

    return _run(kernel)


@scenario
def one_cell_for_all() -> dict[str, np.ndarray]:
    """All threads of a block write to one cell."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        ti.loop_config(block_dim=BLOCK)
        for i in range(N):
            shared = ti.simt.block.SharedArray((BLOCK,), ti.f32)
            shared[i // BLOCK] = x[i]
            ti.simt.block.sync()
            y[i] = shared[0]

    return _run(kernel)


@scenario
def no_barrier() -> dict[str, np.ndarray]:
    """What another thread has written is read at once."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        ti.loop_config(block_dim=BLOCK)
        for i in range(N):
            t = i % BLOCK
            shared = ti.simt.block.SharedArray((BLOCK,), ti.f32)
            shared[t] = x[i]
            y[i] = shared[BLOCK - 1 - t]

    return _run(kernel)


@scenario
def no_last_barrier() -> dict[str, np.ndarray]:
    """A block that goes on to more work overwrites what slower threads still read; with enough blocks, none does."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        ti.loop_config(block_dim=BLOCK)
        for i in range(N):
            t = i % BLOCK
            shared = ti.simt.block.SharedArray((BLOCK,), ti.f32)
            shared[t] = x[i]
            ti.simt.block.sync()
            y[i] = shared[BLOCK - 1 - t]

    return _run(kernel)


@scenario
def atomics_without_barrier() -> dict[str, np.ndarray]:
    """Atomic additions may meet, but a plain read may not meet them."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        ti.loop_config(block_dim=BLOCK)
        for i in range(N):
            t = i % BLOCK
            shared = ti.simt.block.SharedArray((1,), ti.f32)
            if t == 0:
                shared[0] = 0.0
            ti.simt.block.sync()
            ti.atomic_add(shared[0], x[i])
            y[i] = shared[0]

    return _run(kernel)


@scenario
def divergent_barrier() -> dict[str, np.ndarray]:
    """A barrier that only some of the threads reach."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        ti.loop_config(block_dim=BLOCK)
        for i in range(N):
            if i % BLOCK < 100:
                ti.simt.block.sync()
            y[i] = x[i]

    return _run(kernel)


@scenario
def uninitialised() -> dict[str, np.ndarray]:
    """Only half of the shared memory that is read was written."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        ti.loop_config(block_dim=BLOCK)
        for i in range(N):
            t = i % BLOCK
            shared = ti.simt.block.SharedArray((BLOCK,), ti.f32)
            if t < BLOCK // 2:
                shared[t] = x[i]
            ti.simt.block.sync()
            y[i] = shared[t]

    return _run(kernel)


@scenario
def outside_shared() -> dict[str, np.ndarray]:
    """Shared memory is shorter than the index."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        ti.loop_config(block_dim=BLOCK)
        for i in range(N):
            t = i % BLOCK
            shared = ti.simt.block.SharedArray((BLOCK,), ti.f32)
            shared[t + 1] = x[i]
            ti.simt.block.sync()
            y[i] = shared[BLOCK - t]

    return _run(kernel)


@scenario
def outside_array(offset: int = 1) -> dict[str, np.ndarray]:
    """An array is shorter than the index, or the index is negative."""

    @ti.kernel
    def kernel(x: F1, y: F1, offset: ti.i32):
        for i in range(N):
            y[i] = x[i + offset]

    return _run(kernel, offset)


@scenario
def crashing() -> dict[str, np.ndarray]:
    """Taichi 1.7.4 knows subgroup operations for other devices only: under CUDA they end the process."""

    @ti.kernel
    def kernel(x: F1, y: F1):
        for i in range(N):
            y[i] = ti.simt.subgroup.reduce_add(x[i])

    return _run(kernel)


@scenario
def raising() -> dict[str, np.ndarray]:
    """An ordinary exception."""
    raise RuntimeError("for a test")
