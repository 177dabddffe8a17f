"""The same work as `dragfree-validation peers` times, by the Python packages of the field.

    python validation/peers/peers.py TASK FOLDER

reads the inputs that the command wrote to FOLDER, works on one core, and prints a line of JSON for each peer:
`{"peer": ..., "own": ..., "seconds": ..., "result": [...]}`. The result is what the command compares with that of its own
work of this name, before it counts the time. What happens once in a session (imports, compilation, reading of inputs) is not timed.
"""

import json
import os
import sys
import time
from importlib.metadata import version

# One core, whatever the packages would like.
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import numpy as np


def say(package, seconds, result, work="", own=""):
    peer = f"{package} {version(package)}" + (f", {work}" if work else "")
    result = np.asarray(result, dtype=float).ravel().tolist()
    print(json.dumps({"peer": peer, "own": own, "seconds": seconds, "result": result}), flush=True)


def timed(work):
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


class Inputs:
    """Numbers and arrays that the command wrote, by their names."""

    def __init__(self, folder):
        self.folder = folder
        with open(os.path.join(folder, "numbers.json")) as file:
            self.numbers = json.load(file)

    def __getitem__(self, name):
        return self.numbers[name]

    def array(self, name, *shape):
        return np.fromfile(os.path.join(self.folder, name + ".f64")).reshape(shape)


def filter_steps(inputs):
    """A Kalman filter whose transition changes with every step, and the paper's adaptive one."""
    n, m, steps, dt = inputs["states"], inputs["readouts"], inputs["steps"], inputs["dt_s"]
    a_0, h, q = inputs.array("a", n, n), inputs.array("h", m, n), inputs.array("q", n, n)
    x_0, p_0 = inputs.array("x", n), inputs.array("p", n, n)
    r = np.diag(inputs["readout_m2"])
    drive, regressors = inputs.array("drive", steps, 3), inputs.array("regressors", steps, 3, 3)
    readouts = inputs.array("readouts", steps, m)
    r_rows, v_rows = slice(0, 3), slice(3, 6)
    theta = slice(inputs["theta"], inputs["theta"] + 3)

    def transition(k):
        a = a_0.copy()
        a[v_rows, theta] = dt * regressors[k].T
        a[r_rows, theta] = 0.5 * dt**2 * regressors[k].T
        return a

    transitions = np.array([transition(k) for k in range(steps)])
    pushes = np.zeros((steps, n))
    pushes[:, r_rows], pushes[:, v_rows] = 0.5 * dt**2 * drive, dt * drive

    def adaptive():
        alpha = inputs["forgetting"]
        x, p, q_k, r_k, s = x_0.copy(), p_0.copy(), q.copy(), r.copy(), None
        kph, k = np.zeros((n, n)), np.zeros((n, m))
        a = a_0.copy()
        adapt = False
        for phi, u, z in zip(regressors, drive, readouts):
            a[v_rows, theta] = dt * phi.T
            a[r_rows, theta] = 0.5 * dt**2 * phi.T
            carried = a @ (p - kph) @ a.T
            if adapt:
                q_iter = carried + q_k - a @ p @ a.T + k @ s @ k.T
                q_k = alpha * q_k + (1 - alpha) * np.minimum(np.abs(q_iter), q_k)
            p = carried + q_k
            p = 0.5 * (p + p.T)
            x = a @ x
            x[r_rows] += 0.5 * dt**2 * u
            x[v_rows] += dt * u
            d = z - h @ x
            adapt = s is not None
            s = np.outer(d, d) if s is None else s + (1 - alpha) * (np.outer(d, d) - s)
            ph = p @ h.T
            hph = h @ ph
            if adapt:
                r_k = alpha * r_k + np.minimum(np.abs((1 - alpha) * (s - hph)), r_k)
            k = ph @ np.linalg.inv(hph + r_k)
            kph = k @ ph.T
            x = x + k @ d
        return x

    say("numpy", *timed(adaptive), "the paper's recursion as printed", "adaptive")

    def by_filterpy():
        kf = KalmanFilter(dim_x=n, dim_z=m)
        kf.x, kf.P, kf.H, kf.R, kf.Q = x_0.copy(), p_0.copy(), h, r, q
        for a, u, z in zip(transitions, pushes, readouts):
            kf.F = a
            kf.predict()
            kf.x = kf.x + u
            kf.update(z)
        return kf.x

    from filterpy.kalman import KalmanFilter

    say("filterpy", *timed(by_filterpy), "Kalman filter", "plain")

    from statsmodels.tsa.statespace.kalman_filter import MEMORY_CONSERVE, KalmanFilter as Statsmodels

    # Its first step is an update: the state before it is the one that the first transition leads to.
    x_1 = transitions[0] @ x_0 + pushes[0]
    p_1 = transitions[0] @ p_0 @ transitions[0].T + q
    model = Statsmodels(k_endog=m, k_states=n)
    model.bind(readouts)
    # Entry t of these leads from time t to time t + 1.
    after = [*range(1, steps), steps - 1]
    model["transition"] = np.asfortranarray(np.moveaxis(transitions[after], 0, 2))
    model["state_intercept"] = np.asfortranarray(pushes[after].T)
    model["design"], model["obs_cov"], model["state_cov"], model["selection"] = h, r, q, np.eye(n)
    model.initialize_known(x_1, p_1)
    # Never taken for settled.
    model.tolerance = 0
    model.filter()
    seconds, filtered = timed(lambda: model.filter())
    say("statsmodels", seconds, filtered.filtered_state[:, -1], "Kalman filter", "plain")

    import jax

    jax.config.update("jax_enable_x64", True)
    from dynamax.linear_gaussian_ssm.inference import (
        ParamsLGSSM,
        ParamsLGSSMDynamics,
        ParamsLGSSMEmissions,
        ParamsLGSSMInitial,
        lgssm_filter,
    )

    # It adds 1e-9 to what it inverts, so lengths are in picometres here. Entry t of the dynamics leads to time t; the
    # first one is not used.
    unit = np.full(n, 1e12)
    unit[theta] = 1.0
    params = ParamsLGSSM(
        initial=ParamsLGSSMInitial(mean=unit * x_1, cov=np.outer(unit, unit) * p_1),
        dynamics=ParamsLGSSMDynamics(
            weights=jax.numpy.asarray(transitions * np.outer(unit, 1 / unit)),
            bias=jax.numpy.asarray(unit * pushes),
            input_weights=jax.numpy.zeros((n, 0)),
            cov=jax.numpy.asarray(np.outer(unit, unit) * q),
        ),
        emissions=ParamsLGSSMEmissions(
            weights=jax.numpy.asarray(h),
            bias=jax.numpy.zeros(m),
            input_weights=jax.numpy.zeros((m, 0)),
            cov=jax.numpy.asarray(1e24 * r),
        ),
    )
    emissions = jax.numpy.asarray(1e12 * readouts)
    run = jax.jit(lambda params, emissions: lgssm_filter(params, emissions).filtered_means)
    run(params, emissions).block_until_ready()
    seconds, means = timed(lambda: run(params, emissions).block_until_ready())
    say("dynamax", seconds, means[-1] / unit, "Kalman filter, compiled by jax", "plain")


def synthesis(inputs):
    """H-infinity controllers of the channels; the result is the smallest γ of each."""
    from slycot import sb10ad

    plants = []
    for i, plant in enumerate(inputs["plants"]):
        n, outputs, inputs_of = plant["states"], plant["outputs"], plant["inputs"]
        shapes = {"a": (n, n), "b": (n, inputs_of), "c": (outputs, n), "d": (outputs, inputs_of)}
        plants.append((plant, *(inputs.array(f"plant-{i}-{name}", *shape) for name, shape in shapes.items())))

    def controllers():
        gammas = []
        for plant, a, b, c, d in plants:
            answer = sb10ad(
                plant["states"],
                plant["inputs"],
                plant["outputs"],
                plant["controls"],
                plant["measurements"],
                plant["gamma_begin"],
                a.copy(), b.copy(), c.copy(), d.copy(),
                1,
                inputs["relative_tolerance"] * plant["gamma"],
            )
            gammas.append(answer[0])
        return gammas

    say("slycot", *timed(controllers), "SLICOT's SB10AD, bisection")


def decoding(inputs):
    """Every message of a recording; the result is their number and the sum of one column."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    path, topic = inputs["path"], inputs["topic"]
    *fields, last = inputs["field"].split(".")

    def messages():
        count, total = 0, 0.0
        with open(path, "rb") as file:
            for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
                count += 1
                if channel.topic == topic:
                    for field in fields:
                        message = getattr(message, field)
                    total += getattr(message, last)
        return count, total

    say("mcap", *timed(messages), "with mcap-protobuf-support")


def spectra(inputs):
    """Cross-spectra of all pairs of columns, summed over bands."""
    from scipy.signal import csd

    columns, samples, length, rate = inputs["columns"], inputs["samples"], inputs["length"], inputs["rate_hz"]
    data = inputs.array("columns", columns, samples)
    bands = inputs["bands"]
    time_of = np.arange(length) - length // 2
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    w2 = window**2

    def straight(x, axis=-1):
        mean = (x * w2).sum(-1, keepdims=True) / w2.sum()
        slope = (x * w2 * time_of).sum(-1, keepdims=True) / (w2 * time_of**2).sum()
        return x - mean - slope * time_of

    def pairs():
        sums = []
        for i in range(columns):
            for j in range(i + 1):
                _, cross = csd(
                    data[i], data[j], fs=rate, window=window, nperseg=length, noverlap=length // 2, detrend=straight
                )
                sums.append([cross.real[first:end].sum() for first, end in bands])
        # By band, then by pair.
        return np.array(sums).T * (2 * w2.mean())

    say("scipy", *timed(pairs), "signal.csd, pair by pair")


def selection(inputs):
    """Few of many regressors; the result is the coefficient of each, zero where it is not chosen."""
    import warnings

    from pysindy.optimizers import FROLS, STLSQ

    samples, columns = inputs["samples"], inputs["columns"]
    x, y = inputs.array("x", columns, samples).T, inputs.array("y", samples, 1)
    warnings.simplefilter("ignore")
    for name, optimizer in (
        ("STLSQ", STLSQ(threshold=inputs["threshold"], alpha=0.0)),
        ("FROLS", FROLS(kappa=inputs["kappa"], max_iter=inputs["most"])),
    ):
        say("pysindy", *timed(lambda: optimizer.fit(x, y).coef_), name)


TASKS = {
    "filter": filter_steps,
    "synthesis": synthesis,
    "decoding": decoding,
    "spectra": spectra,
    "selection": selection,
}

if __name__ == "__main__":
    TASKS[sys.argv[1]](Inputs(sys.argv[2]))
