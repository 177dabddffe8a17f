"""The three spacecraft by another program, for tests/orbit.rs: elements from their definition, DOP853 of SciPy, Earth by CSPICE.

usage: python3 orbit.py ../../../fixtures/ephemeris . (writes orbit.txt; about a minute)
needs: pip install spiceypy numpy scipy
"""

import sys
from datetime import datetime, timedelta

import numpy as np
import scipy
import spiceypy as spice
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

kernels, out = sys.argv[1], sys.argv[2]
spice.furnsh(f"{kernels}/de440-excerpt.bsp")
spice.furnsh(f"{kernels}/latest_leapseconds.tls")

AU, MU_SUN, MU_EARTH = 149597870700.0, 1.3271244004127942e20, 3.986004355070226e14
ARM, TRAILING = 3.0e9, np.radians(20.0)
DATE = datetime(2035, 1, 1)
EPOCH = spice.str2et(DATE.isoformat())
IRF_FROM_ECLIPTIC = spice.pxform("ECLIPJ2000", "J2000", 0.0)


def earth(et):
    return 1e3 * np.array(spice.spkgps(399, et, "J2000", 10)[0])


def start():
    """Vertex k of the tilted triangle at its aphelion, then turned back along its orbit by k thirds (Nayak et al. 2006)."""
    alpha = ARM / (2 * AU)
    tilt = np.pi / 3 + 5 * alpha / 8
    vertex = AU * np.array([1 + 2 * alpha / np.sqrt(3) * np.cos(tilt), 0, 2 * alpha / np.sqrt(3) * np.sin(tilt)])
    e = np.linalg.norm(vertex) / AU - 1
    inclination = np.arctan2(vertex[2], vertex[0])
    x, y, _ = IRF_FROM_ECLIPTIC.T @ earth(EPOCH)
    centre = np.arctan2(y, x) - TRAILING
    states = []
    for k in range(3):
        turn = 2 * np.pi * k / 3
        # Mean anomaly from perihelion, which lies opposite the vertex.
        mean = np.pi - turn
        anomaly = brentq(lambda E: E - e * np.sin(E) - mean, mean - 0.1, mean + 0.1, xtol=1e-16, rtol=1e-15)
        r = AU * np.array([np.cos(anomaly) - e, np.sqrt(1 - e * e) * np.sin(anomaly), 0])
        n = np.sqrt(MU_SUN / AU**3)
        v = AU * n / (1 - e * np.cos(anomaly)) * np.array([-np.sin(anomaly), np.sqrt(1 - e * e) * np.cos(anomaly), 0])
        # Perihelion is below the ecliptic: argument of perihelion −90°, ascending node 90° before it.
        node = centre + turn + np.pi + np.pi / 2
        turned = Rotation.from_euler("ZXZ", [node, inclination, -np.pi / 2])
        states.append((IRF_FROM_ECLIPTIC @ turned.apply(r), IRF_FROM_ECLIPTIC @ turned.apply(v)))
    return np.array([r for r, _ in states]), np.array([v for _, v in states])


def rates(elapsed, y):
    r, v = y.reshape(2, 3, 3)
    e = earth(EPOCH + elapsed)
    pull = lambda d, mu: -mu * d / np.linalg.norm(d, axis=-1, keepdims=True) ** 3
    return np.concatenate([v, pull(r, MU_SUN) + pull(r - e, MU_EARTH) + pull(e, MU_EARTH)]).ravel()


DAYS = [-200, -91, -3, 0, 1, 7, 25, 31, 90, 182, 273, 365, 730, 1461, 2190]
y0 = np.concatenate(start()).ravel()
with open(f"{out}/orbit.txt", "w") as f:
    f.write(f"# SciPy {scipy.__version__}, DOP853: days of UTC from 2035-01-01, spacecraft, r in m, v in m/s, IRF\n")
    for days in DAYS:
        if days == 0:
            y = y0
        else:
            # TDB − UTC apart: in seconds past J2000 a float has 2.4e-7 s of grain, 7 mm of way. No leap second falls in.
            et = spice.str2et((DATE + timedelta(days=days)).isoformat())
            elapsed = 86400.0 * days + (spice.deltet(et, "ET") - spice.deltet(EPOCH, "ET"))
            # Steps of two days at most: the relative tolerance is at the level of rounding.
            y = solve_ivp(rates, (0.0, elapsed), y0, method="DOP853", rtol=3e-14, atol=1e-6, max_step=2 * 86400.0).y[:, -1]
        for k, (r, v) in enumerate(zip(*y.reshape(2, 3, 3))):
            numbers = " ".join(repr(float(x)) for x in (*r, *v))
            f.write(f"{days} SC{k + 1} {numbers}\n")
