"""Spacecraft and test masses in inertial space with 60 digits, for tests/dynamics.rs.

The equations of motion as the paper derives them, not as the simulator has them: inertial positions, velocities and
attitudes of three bodies (eqs d2r_SC_I, TM_acceleration_inertial, SC_attitude_dynamics and TM_attitude_dynamics with Euler's sign
and the electrodes' reaction -F_E at b_i), gravity of a point-like Sun at each of them; displacements are differences of positions.

usage: python3 dynamics.py . (writes dynamics.txt; some minutes)
needs: pip install gmpy2
"""

import sys

import gmpy2
from gmpy2 import mpfr, sqrt

gmpy2.get_context().precision = 200
END, EVERY, STEP = 1000, 100, "0.25"


def n(x):
    """The decimal number, or the float that the simulator takes it for: that is 1e-16 apart."""
    return mpfr(repr(x)) if isinstance(x, float) else mpfr(x)


def vec(*xs):
    return [n(x) for x in xs]


def add(*vs):
    return [sum(c[1:], c[0]) for c in zip(*vs)]


def sub(a, b):
    return [x - y for x, y in zip(a, b)]


def mul(a, s):
    return [x * s for x in a]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def apply(m, v):
    return [dot(row, v) for row in m]


def transposed(m):
    return [list(c) for c in zip(*m)]


def product(a, b):
    return [[dot(row, col) for col in transposed(b)] for row in a]


def inverse(m):
    a, b, c = transposed(m)
    d = dot(a, cross(b, c))
    return [mul(cross(b, c), 1 / d), mul(cross(c, a), 1 / d), mul(cross(a, b), 1 / d)]


def diagonal(*xs):
    return [[n(xs[i]) if i == j else n(0) for j in range(3)] for i in range(3)]


def dcm(q):
    """Components in the parent frame from components in the turned one; q = (w, x, y, z) turns the parent into it."""
    w, x, y, z = q
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def times(p, q):
    return [p[0] * q[0] - dot(p[1:], q[1:]), *add(mul(q[1:], p[0]), mul(p[1:], q[0]), cross(p[1:], q[1:]))]


def spin(q, omega):
    """q' = q ω/2 with ω in the turned frame."""
    return mul(times(q, [n(0), *omega]), n(1) / 2)


def quaternion(rotation):
    angle = sqrt(dot(rotation, rotation))
    return [gmpy2.cos(angle / 2), *mul(rotation, gmpy2.sin(angle / 2) / angle)]


def conjugate(q):
    return [q[0], -q[1], -q[2], -q[3]]


def rotation(q):
    """Rotation vector of a quaternion with w > 0."""
    s = sqrt(dot(q[1:], q[1:]))
    return mul(q[1:], 2 * gmpy2.atan2(s, q[0]) / s)


# The bodies; tests/dynamics.rs has the same numbers.
MU_SUN = n("1.3271244004127942e20")
SC_MASS = n(1500)
SC_INERTIA = [vec(800, 13, 10), vec(13, 850, 12), vec(10, 12, 1000)]
TM_MASS = n("1.96")
TM_INERTIA = [vec("7e-4", "1e-5", 0), vec("1e-5", "6e-4", "2e-5"), vec(0, "2e-5", "9e-4")]
SC_INVERSE, TM_INVERSE = inverse(SC_INERTIA), inverse(TM_INERTIA)
HALF, ROOT = n(1) / 2, sqrt(n(3)) / 2
SRF_FROM_ORF = [
    [[ROOT, -HALF, n(0)], [HALF, ROOT, n(0)], [n(0), n(0), n(1)]],
    [[ROOT, HALF, n(0)], [-HALF, ROOT, n(0)], [n(0), n(0), n(1)]],
]
Q_ORF_FROM_SRF = [quaternion([n(0), n(0), s * gmpy2.const_pi() / 6]) for s in (1, -1)]
OFFSET = [vec("0.001", "0.18", "-0.02"), vec("0.03", "-0.18", "0.01")]
S_TT = diagonal("-6e-7", "-10e-7", "-12e-7")
S_TR = [vec("1e-9", "2e-10", 0), vec(0, "1e-9", "3e-10"), vec("1e-10", 0, "1e-9")]
S_RT = [mul(row, TM_MASS) for row in product(TM_INVERSE, transposed(S_TR))]
S_RR = diagonal("-1.5e-6", "-1.5e-6", "-2e-6")
R0, V0 = vec("1.2e11", "-0.8e11", "0.3e11"), vec("1.5e4", "2.4e4", "-3e3")
# CRF turns about a fixed axis, by 2e-5 rad/s at first and 1e-9 rad/s² more.
CRF_AXIS, CRF_RATE, CRF_ALPHA = [n(2) / 3, n(-1) / 3, n(2) / 3], n("2e-5"), n("1e-9")


def wave(k, a, c):
    """Eighths from -1 to 1."""
    return n((k * a + c) % 17 - 8) / 8


def loads(k):
    """What acts over the ten seconds number k: force and torque on the spacecraft, and force, torque, acceleration and
    angular acceleration of each test mass."""
    v = lambda size, a, c: [n(size) * wave(k, a + i, c + 5 * i) for i in range(3)]
    return (
        v("1e-4", 3, 1),
        v("1e-4", 5, 2),
        [(v("1e-7", 7 + i, 3 + i), v("1e-10", 4 + i, 4 + i), v("1e-10", 6 + i, 5 + i), v("1e-9", 2 + i, 6 + i)) for i in range(2)],
    )


def gravity(x):
    r2 = dot(x, x)
    return mul(x, -MU_SUN / (r2 * sqrt(r2)))


def relative(y, i):
    """Displacement in ORF, and the quaternion from ORF to MRF."""
    position, _, q_sc, _ = y[0]
    x, _, q_tm, _ = y[1 + i]
    from_housing = sub(apply(transposed(dcm(q_sc)), sub(x, position)), OFFSET[i])
    q_orf = times(q_sc, Q_ORF_FROM_SRF[i])
    return apply(transposed(SRF_FROM_ORF[i]), from_housing), times(conjugate(q_orf), q_tm)


def rates(y, acting):
    position, velocity, q, omega = y[0]
    force, torque, tms = acting
    irf_from_srf = dcm(q)
    torque = sub(torque, cross(omega, apply(SC_INERTIA, omega)))
    out = []
    for i, (f, m, a, alpha) in enumerate(tms):
        f_srf = apply(SRF_FROM_ORF[i], f)
        force = sub(force, f_srf)
        torque = sub(sub(torque, apply(SRF_FROM_ORF[i], m)), cross(OFFSET[i], f_srf))
        x, v, q_tm, w = y[1 + i]
        r, q_mo = relative(y, i)
        angle = mul(q_mo[1:], n(2))
        own = add(mul(f, 1 / TM_MASS), a, apply(S_TT, r), apply(S_TR, angle))
        acceleration = add(gravity(x), apply(irf_from_srf, apply(SRF_FROM_ORF[i], own)))
        moment = sub(apply(transposed(dcm(q_mo)), m), cross(w, apply(TM_INERTIA, w)))
        turning = add(apply(TM_INVERSE, moment), alpha, apply(S_RT, r), apply(S_RR, angle))
        out.append([v, acceleration, spin(q_tm, w), turning])
    acceleration = add(gravity(position), mul(apply(irf_from_srf, force), 1 / SC_MASS))
    return [[velocity, acceleration, spin(q, omega), apply(SC_INVERSE, torque)], *out]


def moved(y, k, h):
    return [[add(a, mul(b, h)) for a, b in zip(body, rate)] for body, rate in zip(y, k)]


def runge_kutta(y, acting, h):
    k1 = rates(y, acting)
    k2 = rates(moved(y, k1, h / 2), acting)
    k3 = rates(moved(y, k2, h / 2), acting)
    k4 = rates(moved(y, k3, h), acting)
    return moved(moved(moved(moved(y, k1, h / 6), k2, h / 3), k3, h / 3), k4, h / 6)


def start():
    q = quaternion(vec("1e-3", "-2e-3", "3e-3"))
    omega = vec("1e-4", "-2e-4", "3e-4")
    bodies = [[R0, V0, q, omega]]
    irf_from_srf = dcm(q)
    for i in range(2):
        r, v = vec("1e-6", "-2e-6", "3e-6"), vec("1e-9", "2e-9", "-1e-9")
        arm = add(OFFSET[i], apply(SRF_FROM_ORF[i], r))
        swing = add(cross(omega, arm), apply(SRF_FROM_ORF[i], v))
        q_tm = times(times(q, Q_ORF_FROM_SRF[i]), quaternion(vec("1e-4", "2e-4", "-3e-4")))
        bodies.append([
            add(R0, apply(irf_from_srf, arm)), add(V0, apply(irf_from_srf, swing)), q_tm, vec("2e-4", "-1e-4", "1e-4"),
        ])
    return bodies


def fly(step):
    """Rows of time, r_1, r_2, attitude of the spacecraft against CRF, angles of the test masses."""
    y, rows = start(), []
    for k in range(END // 10):
        acting = loads(k)
        for _ in range(round(10 / float(step))):
            y = runge_kutta(y, acting, n(step))
        t = n(10 * (k + 1))
        if (10 * (k + 1)) % EVERY == 0:
            (r1, q1), (r2, q2) = relative(y, 0), relative(y, 1)
            q_crf = quaternion(mul(CRF_AXIS, CRF_RATE * t + CRF_ALPHA * t * t / 2))
            q_sc = times(conjugate(q_crf), y[0][2])
            rows.append([t, *r1, *r2, *rotation(q_sc), *rotation(q1), *rotation(q2)])
    return rows


fine = fly(STEP)
coarse = fly(str(2 * float(STEP)))
worst = max(abs(a - b) for x, y in zip(fine, coarse) for a, b in zip(x, y))
with open(f"{sys.argv[1]}/dynamics.txt", "w") as f:
    f.write("# t in s; r_1 and r_2 in ORF, m; attitude of SRF against CRF, of MRF_1 and MRF_2 against ORF, rotation vectors, rad\n")
    f.write(f"# classical Runge-Kutta, {STEP} s, 60 digits; twice the step changes a number by {float(worst):.1e} at most\n")
    for row in fine:
        f.write(" ".join(repr(float(x)) for x in row) + "\n")
