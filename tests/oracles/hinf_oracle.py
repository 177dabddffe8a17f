"""Compares the H-infinity synthesis of dragfree-physics with SLICOT (routine SB10AD, through slycot).

    cargo run --release -p dragfree-physics --example hinf_problems > problems.json
    python hinf_oracle.py problems.json > hinf_oracle.txt

`problems.json` holds the generalized plants and gammas of the fifteen channels and of the published benchmarks. The
benchmarks are built here, by python-control, when they are asked for:

    python hinf_oracle.py --benchmarks > hinf_benchmarks.json

SB10AD's own iteration on gamma stops at an absolute tolerance and is sometimes far from the optimum; here gamma is
bisected to 1e-6 (relative), and SB10AD only says whether it finds a controller at a given gamma (job 4).
"""

import json
import sys
import warnings

import control
import numpy as np
import slycot

RELATIVE_TOLERANCE = 1e-3


def mixed(g, w1=None, w2=None, w3=None):
    """Generalized plant of a mixed-sensitivity problem."""
    return control.augw(g, w1, w2, w3), g.noutputs, g.ninputs


def normalised_coprime(g):
    """Glover and McFarlane's four-block problem: w = (noise on y, disturbance of u), z = (y, u)."""
    p, m, n = g.noutputs, g.ninputs, g.nstates
    b = np.hstack([np.zeros((n, p)), g.B, g.B])
    c = np.vstack([g.C, np.zeros((m, n)), g.C])
    d = np.block([
        [np.eye(p), np.zeros((p, m)), np.zeros((p, m))],
        [np.zeros((m, p)), np.zeros((m, m)), np.eye(m)],
        [np.eye(p), np.zeros((p, m)), np.zeros((p, m))],
    ])
    return control.ss(g.A, b, c, d), p, m


def himat():
    a = np.array([
        [-2.2567e-02, -3.6617e+01, -1.8897e+01, -3.2090e+01, 3.2509e+00, -7.6257e-01],
        [9.2572e-05, -1.8997e+00, 9.8312e-01, -7.2562e-04, -1.7080e-01, -4.9652e-03],
        [1.2338e-02, 1.1720e+01, -2.6316e+00, 8.7582e-04, -3.1604e+01, 2.2396e+01],
        [0, 0, 1, 0, 0, 0],
        [0, 0, 0, 0, -30, 0],
        [0, 0, 0, 0, 0, -30],
    ])
    b = np.zeros((6, 2))
    b[4, 0] = b[5, 1] = 30
    c = np.zeros((2, 6))
    c[0, 1] = c[1, 3] = 1
    return control.ss(a, b, c, np.zeros((2, 2)))


def slicot_example():
    a = [[-1, 0, 4, 5, -3, -2], [-2, 4, -7, -2, 0, 3], [-6, 9, -5, 0, 2, -1],
         [-8, 4, 7, -1, -3, 0], [2, 5, 8, -9, 1, -4], [3, -5, 8, 0, 2, -6]]
    b = [[-3, -4, -2, 1, 0], [2, 0, 1, -5, 2], [-5, -7, 0, 7, -2], [4, -6, 1, 1, -2], [-3, 9, -8, 0, 5],
         [1, -2, 3, -6, -2]]
    c = [[1, -1, 2, -4, 0, -3], [-3, 0, 5, -1, 1, 1], [-7, 5, 0, -8, 2, -2], [9, -3, 4, 0, 3, 7], [0, 1, -2, 1, -6, -2]]
    d = [[1, -2, -3, 0, 0], [0, 4, 0, 1, 0], [5, -3, -4, 0, 1], [0, 1, 0, 1, -3], [0, 0, 1, 7, 1]]
    return control.ss(a, b, c, d), 2, 2


def scherer_example():
    a = [[0, 10, 2], [-1, 1, 0], [0, 2, -5]]
    return control.ss(a, [[1, 0], [0, 1], [1, 0]], [[1, 0, 0], [0, 0, 0], [0, 1, 0]], [[0, 0], [0, 1], [2, 0]]), 1, 1


def benchmarks():
    """Name, source, published gamma or closed form where there is one, problem."""
    s = control.tf("s")
    disturbance = 200 / ((10 * s + 1) * (0.05 * s + 1) ** 2)
    diag = lambda w: control.append(control.ss(w), control.ss(w))
    aircraft = himat()
    w1 = diag((s / 2 + 5) / (s + 0.03 * 5))
    w3 = diag((s + 20 / 2) / (0.05 * s + 20))
    w2 = control.ss([], [], [], 0.01 * np.eye(2))
    double = control.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]])
    return [
        ("skogestad-1", "Skogestad and Postlethwaite, Multivariable Feedback Control, section 2.8.3, first weight", 1.37,
         mixed(control.ss(disturbance), control.ss((s / 1.5 + 10) / (s + 10 * 1e-4)), control.ss([], [], [], 1.0))),
        ("skogestad-2", "the same, second weight", None,
         mixed(control.ss(disturbance), control.ss((s / 1.5**0.5 + 10) ** 2 / (s + 10 * 1e-2) ** 2),
               control.ss([], [], [], 1.0))),
        ("mixsyn", "MATLAB Robust Control Toolbox, reference page of mixsyn", None,
         mixed(control.ss((s - 1) / (s + 1) ** 2), control.ss(0.1 * (s + 100) / (100 * s + 1)),
               control.ss([], [], [], 0.1))),
        ("himat", "HiMAT aircraft of Safonov, Laub and Hartmann, weights of MATLAB's demo, control weight 0.01", None,
         mixed(aircraft, w1, w2, w3)),
        ("himat-coprime", "HiMAT aircraft, normalised coprime factors", None, normalised_coprime(aircraft)),
        ("scherer", "Scherer, Gahinet and Chilali, IEEE Trans. Autom. Control 42, 896 (1997), example 7", None,
         scherer_example()),
        ("slicot", "after SLICOT's example of SB10FD, D11 and D22 not zero; the matrices that count are those listed here", None, slicot_example()),
        ("integrator", "normalised coprime factors of 1/s: sqrt(2)", 2**0.5,
         normalised_coprime(control.ss([[0]], [[1]], [[1]], [[0]]))),
        ("double-integrator", "normalised coprime factors of 1/s^2: sqrt(4 + 2 sqrt(2))", (4 + 8**0.5) ** 0.5,
         normalised_coprime(double)),
    ]


def found(problem, gamma):
    """Whether SB10AD finds a controller at this gamma."""
    a, b, c, d = (np.array(problem[k], dtype=float) for k in "abcd")
    try:
        slycot.sb10ad(a.shape[0], b.shape[1], c.shape[0], problem["controls"], problem["measurements"], gamma, a, b, c, d,
                      job=4)
        return True
    except Exception:
        return False


def slicot_gamma(problem):
    high = 1e-3
    while not found(problem, high):
        high *= 2
        if high > 1e9:
            return float("nan")
    low = high / 2
    while high > low * (1 + 1e-6):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if found(problem, middle) else (middle, high)
    return high


def write_benchmarks():
    out = []
    for name, source, published, (system, measurements, controls) in benchmarks():
        problem = {"name": name, "source": source, "measurements": measurements, "controls": controls}
        problem.update({k: np.asarray(getattr(system, k.upper())).tolist() for k in "abcd"})
        problem["slicot_gamma"] = slicot_gamma(problem)
        problem["published_gamma"] = published
        out.append(problem)
    json.dump(out, sys.stdout, indent=1)
    print()


def compare(path):
    print(f"slycot {slycot.__version__}, python-control {control.__version__}: SB10AD bisected to 1e-6")
    print(f"{'problem':20} {'states':>6} {'SLICOT':>12} {'dragfree':>12} {'difference':>11}")
    worst = 0.0
    with open(path) as file:
        problems = json.load(file)
    for problem in problems:
        reference = slicot_gamma(problem)
        difference = problem["gamma"] / reference - 1
        worst = max(worst, abs(difference) if np.isfinite(difference) else np.inf)
        print(f"{problem['name']:20} {len(problem['a']):6} {reference:12.6f} {problem['gamma']:12.6f} {difference:11.1e}")
    print(f"largest difference {worst:.1e}, allowed {RELATIVE_TOLERANCE:.0e}: {'pass' if worst < RELATIVE_TOLERANCE else 'FAIL'}")
    return 0 if worst < RELATIVE_TOLERANCE else 1


if __name__ == "__main__":
    warnings.filterwarnings("ignore")
    if sys.argv[1:] == ["--benchmarks"]:
        write_benchmarks()
    else:
        sys.exit(compare(sys.argv[1]))
