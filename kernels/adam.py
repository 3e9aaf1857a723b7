"""Adam: one fused pass over the parameters, gradients and moments of all groups, rows in parallel."""

import taichi as ti

GROUPS = 5  # at most
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
Values = ti.types.ndarray(dtype=ti.f32)  # [N] or [N, C]
Rates = ti.types.vector(GROUPS, ti.f32)


@ti.func
def update(g, m_old, v_old, gain1, gain2, epsilon, correct_m, correct_v):
    """New moments, and what to subtract from the parameter for a learning rate of 1."""
    m = m_old + gain1 * (g - m_old)
    v = v_old + gain2 * (g * g - v_old)
    return m, v, m * correct_m / (ti.sqrt(v * correct_v) + epsilon)


@ti.kernel
def adam_rows(
    rows: ti.i32,  # rows in use, at most the length of each array
    rates: Rates,  # by group
    gain1: ti.f32,  # 1 - beta1, rounded once: 1 - 0.999 in float32 is 5e-5 off
    gain2: ti.f32,  # 1 - beta2
    epsilon: ti.f32,
    correction: F2,  # [T, 2] 1 / (1 - beta^t) of both moments after t updates; the last row holds for every later t
    visible: I1,  # [N] 0 = leave the row alone
    steps: I1,  # [N] updates that each row has had, in and out
    moments: F2,  # [N, M] in and out; of a group, C first moments and C second ones from its first column on
    gradient0: Values,  # of the first group, and so on; those beyond the last group are not looked at
    parameter0: Values,  # in and out
    gradient1: Values,
    parameter1: Values,
    gradient2: Values,
    parameter2: Values,
    gradient3: Values,
    parameter3: Values,
    gradient4: Values,
    parameter4: Values,
    groups: ti.template(),  # for each group, its first column in `moments` and its C, 0 for arrays [N]
):
    """Adam with a bias correction of its own for each row; rows that are not visible keep value and moments."""
    for i in range(rows):
        if visible[i] != 0:
            steps[i] += 1
            t = ti.min(steps[i], correction.shape[0] - 1)
            correct_m, correct_v = correction[t, 0], correction[t, 1]
            for k in ti.static(range(len(groups))):
                gradient = ti.static((gradient0, gradient1, gradient2, gradient3, gradient4)[k])
                parameter = ti.static((parameter0, parameter1, parameter2, parameter3, parameter4)[k])
                for c in ti.static(range(max(groups[k][1], 1))):
                    at = ti.static((i, c) if groups[k][1] else (i,))
                    m = ti.static(groups[k][0] + c)
                    v = ti.static(m + max(groups[k][1], 1))
                    moments[i, m], moments[i, v], change = update(
                        gradient[at], moments[i, m], moments[i, v], gain1, gain2, epsilon, correct_m, correct_v
                    )
                    parameter[at] -= rates[k] * change
