"""The machine's own throughput of multiply-adds, as Taichi compiles them: what other kernels are measured against."""

import taichi as ti

from tgslam.kernels.simd import LANES, Lanes, lanes_kernel

nd = ti.types.ndarray

# Chains that do not depend on one another. Few of them leave the units waiting for each other's results; many do not
# fit into the registers of a CPU whose vectors are short. The most that any number reaches is the peak.
CHAINS = (6, 12)
_THREAD_STEP = 512  # iterations that Taichi hands a thread at a time


def flops_per_step(chains: int) -> int:
    """A multiplication and an addition in each lane of each chain."""
    return 2 * LANES * chains


@lanes_kernel
def multiply_add(
    steps: ti.i32,
    factor: ti.f32,
    offset: ti.f32,
    chains: ti.template(),  # one of CHAINS
    out: nd(Lanes, ndim=2),  # [parts, at least chains] in and out: x of each chain; a thread takes whole parts
):
    """x = x * factor + offset, `steps` times in every chain, with all of them in registers."""
    for spread in range(out.shape[0] * _THREAD_STEP):
        part = spread // _THREAD_STEP
        if spread - part * _THREAD_STEP == 0:
            a, b = Lanes(factor), Lanes(offset)
            x0, x1, x2, x3, x4, x5 = (
                out[part, 0], out[part, 1], out[part, 2], out[part, 3], out[part, 4], out[part, 5]
            )  # fmt: skip
            y0, y1, y2, y3, y4, y5 = x0, x1, x2, x3, x4, x5
            for _ in range(steps):
                x0 = x0 * a + b
                x1 = x1 * a + b
                x2 = x2 * a + b
                x3 = x3 * a + b
                x4 = x4 * a + b
                x5 = x5 * a + b
                if ti.static(chains == 12):
                    y0 = y0 * b + a
                    y1 = y1 * b + a
                    y2 = y2 * b + a
                    y3 = y3 * b + a
                    y4 = y4 * b + a
                    y5 = y5 * b + a
            out[part, 0], out[part, 1], out[part, 2], out[part, 3] = x0 + y0, x1 + y1, x2 + y2, x3 + y3
            out[part, 4], out[part, 5] = x4 + y4, x5 + y5
