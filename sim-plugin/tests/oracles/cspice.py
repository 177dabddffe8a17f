"""Positions and times as CSPICE gives them, for tests/orbit.rs.

usage: python3 cspice.py ../../../fixtures/ephemeris . (writes cspice_positions.txt and cspice_times.txt)
needs: pip install spiceypy numpy
"""

import sys

import numpy as np
import spiceypy as spice

kernels, out = sys.argv[1], sys.argv[2]
spice.furnsh(f"{kernels}/de440-excerpt.bsp")
spice.furnsh(f"{kernels}/latest_leapseconds.tls")

PAIRS = [(10, 0), (3, 0), (399, 3), (301, 3)]
FIRST, LAST = 1086004800.0, 1293883200.0
# Borders of records: 16 days for Sun and barycentre, 4 days for Earth and Moon.
INIT = 1085832000.0
borders = [INIT + k * 1382400.0 for k in (1, 2, 75, 149, 150)] + [INIT + k * 345600.0 for k in (1, 301, 601)]
near = [b + d for b in borders for d in (-1e-6, 0.0, 1e-6)]
inside = np.random.default_rng(440).uniform(FIRST, LAST, 36)
epochs = sorted([FIRST, FIRST + 1e-6, LAST - 1e-6, LAST, *near, *inside])

with open(f"{out}/cspice_positions.txt", "w") as f:
    f.write(f"# {spice.tkvrsn('TOOLKIT')}, spkgps: TDB seconds past J2000, target, centre, x y z in km, frame J2000\n")
    for et in epochs:
        for target, centre in PAIRS + [(399, 10)]:
            x, y, z = spice.spkgps(target, et, "J2000", centre)[0]
            f.write(f"{float(et)!r} {target} {centre} {float(x)!r} {float(y)!r} {float(z)!r}\n")

TIMES = [
    "1972-01-01T00:00:00", "1979-12-31T23:59:59", "1999-12-31T12:00:00", "2000-01-01T12:00:00", "2016-12-31T23:59:59",
    "2017-01-01T00:00:00", "2034-06-01T00:00:00", "2034-09-30T06:30:00.25", "2035-01-01T00:00:00", "2035-01-25T23:59:59.9",
    "2035-04-03T12:00:00", "2035-07-04T01:02:03.004", "2035-10-05T00:00:00", "2036-02-29T12:00:00", "2037-11-11T11:11:11.1",
    "2038-01-19T03:14:08", "2039-06-30T23:59:59.999", "2040-12-31T00:00:00",
]
with open(f"{out}/cspice_times.txt", "w") as f:
    f.write(f"# {spice.tkvrsn('TOOLKIT')}, str2et: UTC, TDB seconds past J2000\n")
    for text in TIMES:
        f.write(f"{text} {float(spice.str2et(text))!r}\n")
