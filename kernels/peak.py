"""The machine's own throughput of multiply-adds, as Taichi compiles them: what other kernels are measured against."""

import taichi as ti

from tgslam.kernels.simd import LANES, Lanes, lanes_kernel

nd = ti.types.ndarray

CHAINS = 8  # independent of one another: enough to hide the latency of an addition behind the others
FLOPS_PER_STEP = 2 * LANES * CHAINS  # a multiplication and an addition in each lane of each chain
_THREAD_STEP = 512  # iterations that Taichi hands a thread at a time


@lanes_kernel
def multiply_add(
    steps: ti.i32,
    factor: ti.f32,
    offset: ti.f32,
    out: nd(Lanes, ndim=2),  # [parts, CHAINS] in and out: x of each chain of each part; a thread takes whole parts
):
    """x = x * factor + offset, `steps` times in every chain, with all of them in registers."""
    for spread in range(out.shape[0] * _THREAD_STEP):
        part = spread // _THREAD_STEP
        if spread - part * _THREAD_STEP == 0:
            a, b = Lanes(factor), Lanes(offset)
            x0, x1, x2, x3 = out[part, 0], out[part, 1], out[part, 2], out[part, 3]
            x4, x5, x6, x7 = out[part, 4], out[part, 5], out[part, 6], out[part, 7]
            for _ in range(steps):
                x0 = x0 * a + b
                x1 = x1 * a + b
                x2 = x2 * a + b
                x3 = x3 * a + b
                x4 = x4 * a + b
                x5 = x5 * a + b
                x6 = x6 * a + b
                x7 = x7 * a + b
            out[part, 0], out[part, 1], out[part, 2], out[part, 3] = x0, x1, x2, x3
            out[part, 4], out[part, 5], out[part, 6], out[part, 7] = x4, x5, x6, x7
