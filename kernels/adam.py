"""Adam kernels: one fused pass over parameter, gradient and both moments, rows in parallel."""

import taichi as ti

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)


@ti.kernel
def count_steps(
    rows: ti.i32,  # rows in use, at most the length of each array
    visible: I1,  # [N] 0 = leave the row alone
    steps: I1,  # [N] updates that each row has had, in and out
):
    """Count one more update for every visible row."""
    for i in range(rows):
        steps[i] = steps[i] + ti.select(visible[i] != 0, 1, 0)


@ti.func
def update(g, m_old, v_old, gain1, gain2, epsilon, correct_m, correct_v):
    """New moments, and what to subtract from the parameter for a learning rate of 1."""
    m = m_old + gain1 * (g - m_old)
    v = v_old + gain2 * (g * g - v_old)
    return m, v, m * correct_m / (ti.sqrt(v * correct_v) + epsilon)


@ti.kernel
def adam_rows(
    rows: ti.i32,
    rate: ti.f32,
    gain1: ti.f32,  # 1 - beta1, rounded once: 1 - 0.999 in float32 is 5e-5 off
    gain2: ti.f32,  # 1 - beta2
    epsilon: ti.f32,
    correction: F2,  # [T, 2] 1 / (1 - beta^t) of both moments after t updates; the last row holds for every later t
    steps: I1,  # [N] updates including this one
    visible: I1,  # [N]
    gradient: F2,  # [N, C]
    parameter: F2,  # [N, C] in and out
    m: F2,  # [N, C] first moment, in and out
    v: F2,  # [N, C] second moment, in and out
    channels: ti.template(),  # C: known to the compiler, the row is loaded and stored at once
):
    """Adam with a bias correction of its own for each row; rows that are not visible keep value and moments."""
    for i in range(rows):
        if visible[i] != 0:
            t = ti.min(steps[i], correction.shape[0] - 1)
            correct_m, correct_v = correction[t, 0], correction[t, 1]
            g = ti.Vector([gradient[i, c] for c in ti.static(range(channels))])
            m_old = ti.Vector([m[i, c] for c in ti.static(range(channels))])
            v_old = ti.Vector([v[i, c] for c in ti.static(range(channels))])
            value = ti.Vector([parameter[i, c] for c in ti.static(range(channels))])
            m_new, v_new, change = update(g, m_old, v_old, gain1, gain2, epsilon, correct_m, correct_v)
            value = value - rate * change
            for c in ti.static(range(channels)):
                m[i, c] = m_new[c]
                v[i, c] = v_new[c]
                parameter[i, c] = value[c]


@ti.kernel
def adam_scalars(
    rows: ti.i32,
    rate: ti.f32,
    gain1: ti.f32,  # 1 - beta1
    gain2: ti.f32,  # 1 - beta2
    epsilon: ti.f32,
    correction: F2,  # [T, 2]
    steps: I1,  # [N]
    visible: I1,  # [N]
    gradient: F1,  # [N]
    parameter: F1,  # [N] in and out
    m: F1,  # [N] in and out
    v: F1,  # [N] in and out
):
    """`adam_rows` for a parameter with one value a row."""
    for i in range(rows):
        if visible[i] != 0:
            t = ti.min(steps[i], correction.shape[0] - 1)
            m_new, v_new, change = update(
                gradient[i], m[i], v[i], gain1, gain2, epsilon, correction[t, 0], correction[t, 1]
            )
            m[i] = m_new
            v[i] = v_new
            parameter[i] = parameter[i] - rate * change
