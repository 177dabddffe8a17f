"""Quadratic problems with their solutions by another program, for `../qp_oracle.rs`.

    pip install numpy==2.4.* quadprog==0.1.14
    python qp_oracle.py > qp_oracle.json

Solver: quadprog, the dual active-set method of Goldfarb and Idnani (Math. Prog. 27, 1983) in doubles on dense matrices. It knows
nothing of interior points. Problems: `random` (well scaled), and `offsets`, shaped like a calibration: six offsets of which the
data know y and z a hundred times better than x, a survey of 20 um, boxes of 2 cm, some of them wrong so that rows are active.
"""

import json

import numpy as np
import quadprog


def solve(normal, right, rows):
    """min 1/2 t'Nt - c't, lower <= a't <= upper; multipliers per row, positive at the upper bound, negative at the lower."""
    a = [r["terms"] for r in rows] + [[-t for t in r["terms"]] for r in rows]
    b = [r["lower"] for r in rows] + [-r["upper"] for r in rows]
    # In units of sigma with the others held, as the method squares what it is given.
    scale = 1 / np.sqrt(np.diag(normal))
    p = normal * np.outer(scale, scale)
    cols = np.array(a).T * scale[:, None]
    size = np.linalg.norm(cols, axis=0)
    x, _, _, _, z, _ = quadprog.solve_qp(p, right * scale, cols / size, np.array(b) / size)
    z = z / size
    n = len(rows)
    return (x * scale).tolist(), (z[n:] - z[:n]).tolist()


def random_problem(rng, n, m):
    f = rng.normal(size=(n, n))
    normal = f @ f.T + 0.1 * np.eye(n)
    right = 3 * rng.normal(size=n)
    rows = []
    for _ in range(m):
        middle, half = 0.3 * rng.normal(), rng.uniform(0.05, 1.5)
        rows.append({"terms": rng.normal(size=n).tolist(), "lower": middle - half, "upper": middle + half})
    return normal, right, rows


def offsets_problem(rng):
    sigma = np.array([0.02, 4e-4, 3e-4, 0.02, 4e-4, 3e-4])
    f = np.eye(6) + 0.3 * rng.normal(size=(6, 6))
    normal = (f @ f.T) / np.outer(sigma, sigma)
    truth = np.array([0.0908660, 0.1553846, 0.0, 0.0908660, -0.1553846, 0.0]) + 1e-3 * rng.normal(size=6)
    right = normal @ truth + np.linalg.cholesky(normal) @ rng.normal(size=6)
    c, s = np.sqrt(0.75), 0.5
    to_srf = [np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])]
    rows = []
    for axis, baseline in enumerate([0.0, 0.36, 0.0]):
        terms = np.concatenate([to_srf[0][axis], -to_srf[1][axis]])
        error = rng.choice([0.0, 1e-3]) * rng.normal()
        middle = terms @ truth + error
        rows.append({"terms": terms.tolist(), "lower": middle - 2e-5, "upper": middle + 2e-5})
    for mass in range(2):
        for axis in range(3):
            terms = np.zeros(6)
            terms[3 * mass : 3 * mass + 3] = to_srf[mass][axis]
            middle = terms @ truth + rng.choice([0.0, 0.02]) * rng.normal()
            rows.append({"terms": terms.tolist(), "lower": middle - 0.02, "upper": middle + 0.02})
    return normal, right, rows


def main():
    rng = np.random.default_rng(1)
    problems = []
    while len(problems) < 60:
        if len(problems) % 2:
            kind, (normal, right, rows) = "offsets", offsets_problem(rng)
        else:
            n = int(rng.integers(2, 9))
            kind, (normal, right, rows) = "random", random_problem(rng, n, int(rng.integers(1, 7)))
        try:
            theta, multipliers = solve(normal, right, rows)
        except ValueError:  # no point satisfies all rows
            theta, multipliers = None, None
        problems.append(
            {
                "kind": kind,
                "normal": normal.tolist(),
                "right": right.tolist(),
                "rows": rows,
                "theta": theta,
                "multipliers": multipliers,
            }
        )
    print(json.dumps({"solver": "quadprog 0.1.14", "problems": problems}))


main()
