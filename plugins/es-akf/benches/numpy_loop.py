"""The printed recursion (eqs Final_AKF_X_k to Final_AKF_p_k1) with 22 states as a loop in numpy: time of a step.

    python plugins/es-akf/benches/numpy_loop.py

needs numpy and nothing else. A(t) is filled in anew each step, as in `step.rs` beside this file, whose model and numbers
these are. One thread: matrices of 22 by 22 gain nothing from more.

Measured beside `cargo bench -p dragfree-es-akf --bench step`: see numpy_loop.txt.
"""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"

import platform
import time
from math import factorial

import numpy as np

DT = 0.1
LEAK = 2 * np.pi * 1e-4
ALPHA = 0.999_999
ASD = (1.42e-12, 1.8e-9, 1.8e-9)
EXPONENTS = ((4, 2, 2), (4, 2), (4, 2))
PHI = np.array([[0.0, 1e-9, -2e-9], [-1e-9, 0.0, 3e-9], [2e-9, -3e-9, 0.0]])
READOUT = np.array([1e-12, -2e-9, 1e-9])


def moment(n, c, t):
    """Integral of s^n e^(-c s) over a step, as its power series."""
    return sum(t ** (n + 1 + k) * (-c) ** k / (factorial(k) * (n + 1 + k)) for k in range(20))


def model():
    n = 12 + sum(p // 2 for chain in EXPONENTS for p in chain)
    a, q, p = np.eye(n), np.zeros((n, n)), np.zeros((n, n))
    h = np.zeros((3, n))
    for i in range(3):
        h[i, i] = 1.0
        a[i, 3 + i] = a[3 + i, 6 + i] = DT
        a[i, 6 + i] = 0.5 * DT**2
        force = (1e-7 / 1500.0) ** 2 * 0.5 / DT
        q[i, i], q[3 + i, 3 + i] = force * DT**4 / 4, force * DT**2
        q[i, 3 + i] = q[3 + i, i] = force * DT**3 / 2
        q[6 + i, 6 + i] = 1e-30
        p[i, i], p[3 + i, 3 + i], p[6 + i, 6 + i], p[9 + i, 9 + i] = 1e-14, 1e-16, 1e-18, 1e-2
    at = 12
    for axis, chains in enumerate(EXPONENTS):
        for exponent in chains:
            m = exponent // 2
            h[axis, at] = 1.0
            drive = 0.5 * ASD[axis] ** 2 * (2 * np.pi * 1e-3) ** exponent
            for i in range(m):
                for j in range(m):
                    if j >= i:
                        a[at + i, at + j] = np.exp(-LEAK * DT) * DT ** (j - i) / factorial(j - i)
                    e, f = m - 1 - i, m - 1 - j
                    scale = drive / (factorial(e) * factorial(f))
                    q[at + i, at + j] = scale * moment(e + f, 2 * LEAK, DT)
                    p[at + i, at + j] = scale * factorial(e + f) / (2 * LEAK) ** (e + f + 1)
            at += m
    return a, h, q, p


def main():
    a, h, q, p = model()
    n = a.shape[0]
    r = np.diag([s * s * 0.5 / DT for s in ASD])
    s, x, b_u = r.copy(), np.zeros(n), np.zeros(n)

    def step():
        nonlocal x, s, r, q, p
        a[3:6, 9:12] = DT * PHI
        a[0:3, 9:12] = 0.5 * DT**2 * PHI
        x = a @ x + b_u
        d = READOUT - h @ x
        s = ALPHA * s + (1 - ALPHA) * np.outer(d, d)
        ph = p @ h.T
        hph = h @ ph
        r = ALPHA * r + np.minimum(np.abs((1 - ALPHA) * (s - hph)), r)
        k = ph @ np.linalg.inv(hph + r)
        x = x + k @ d
        apa = a @ p @ a.T
        carried = a @ (p - k @ ph.T) @ a.T
        q_iter = carried + q - apa + k @ s @ k.T
        q = ALPHA * q + (1 - ALPHA) * np.minimum(np.abs(q_iter), q)
        p = carried + q
        p = 0.5 * (p + p.T)

    stretches = []
    for _ in range(200):
        start = time.perf_counter()
        for _ in range(100):
            step()
        stretches.append((time.perf_counter() - start) / 100)
    assert n == 22 and np.isfinite(p).all()
    stretches.sort()
    print(f"numpy {np.__version__}, Python {platform.python_version()}, {platform.machine()}, {n} states")
    print(f"best of 200 stretches of 100 steps {1e6 * stretches[0]:.1f} us, median {1e6 * stretches[100]:.1f} us a step")


main()
