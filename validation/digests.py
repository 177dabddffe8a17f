#!/usr/bin/env python3
"""Compares the results of two builds value by value: coefficients, sigmas, covariances, statistics, normal equations, the
JSON of compare, diagnose, ladder and design, and simulated files byte by byte. Provenance and sentences are left out.

    python3 validation/digests.py BEFORE AFTER [--quick] [CASE ...]

BEFORE and AFTER are two builds of the program, `target/release/dragfree` of two checkouts with their plugins beside them. The
telemetry is simulated once, by BEFORE. Each build reads the missions, models and pipelines of this repository. Exit 0: equal
but for keys that one side alone has, which are listed; 1: a value differs, and the first ones are printed.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile

FIXTURES = os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), "fixtures")
MISSION = f"{FIXTURES}/missions/taiji.toml"
THRUSTERS = f"{FIXTURES}/missions/taiji-thrusters.toml"
SCIENCE = f"{FIXTURES}/pipelines/science-mode.toml"
OFFSETS = ["com-offset:tm1", "com-offset:tm2"]
PROVENANCE = {"path", "date_created", "software_version", "sha256", "history", "inputs", "attachments", "supersedes", "notes"}

TELEMETRY = {
    "1h": (MISSION, "--hours 1 --seed 1"),
    "2h": (MISSION, "--hours 2 --seed 5"),
    "thrusters": (THRUSTERS, "--hours 2 --seed 4"),
    "no-command": (MISSION, "--hours 2 --seed 6 --no-command"),
    "thermal": (MISSION, "--hours 3 --seed 7 --effect thermal:tm1.x=2e-12,lag_s=480"),
    "gain": (MISSION, "--hours 6 --seed 3 --effect mps-gain:sc.y=0.1"),
    "day": (MISSION, "--days 1 --seed 2"),
}

# name: (quick, telemetry, mission, effects beside the offsets, commands on the product)
RUNS = {
    "quiet": (True, "1h", MISSION, [], []),
    "readouts": (True, "2h", MISSION, ["es-crosstalk:tm2.y-x", "is-scale:tm1.y"], []),
    "slow": (True, "2h", MISSION, ["stiffness:tm1.x", "tilt-to-length:tm2", "opening-angle:tm1", "solar-pressure:sc"], []),
    "delay": (True, "2h", MISSION, ["mps-gain:sc.z", "time-offset:dws"], []),
    "thrusters": (True, "thrusters", THRUSTERS, [], []),
    "no-command": (True, "no-command", MISSION, [], []),
    "gains": (True, "gain", MISSION, ["mps-gain:sc.y", "torque-gain:sc.x"], ["compare"]),
    "missing-gain": (False, "gain", MISSION, [], ["compare", "diagnose"]),
    "missing-force": (False, "thermal", MISSION, [], ["diagnose"]),
    "day": (False, "day", MISSION, [], []),
}
SIMULATIONS = {
    "simulate": (MISSION, "--hours 1 --seed 1"),
    "simulate-effects": (MISSION, "--hours 1 --seed 9 --effect slosh:sc.x=0.02 --effect magnetic:tm1=1 --effect charge:tm2=1e-12"),
    "simulate-thrusters": (THRUSTERS, "--hours 1 --seed 2"),
}
OTHERS = ["chained", "ladder", "accelerometer", "design", "design-thrusters"]
SLOW = ["ladder"]


def call(program, folder, *arguments):
    done = subprocess.run([program, *arguments, "-q"], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3, 4):
        raise SystemExit(f"{' '.join(arguments)}: exit {done.returncode}\n{done.stderr[-2000:]}")
    return done.stdout


def digest(data):
    return hashlib.sha256(data if isinstance(data, bytes) else json.dumps(data).encode()).hexdigest()[:24]


def values(document, at=""):
    """Every value with its path; a long list is one digest."""
    if isinstance(document, dict):
        for key, value in document.items():
            if key not in PROVENANCE:
                yield from values(value, f"{at}/{key}")
    elif isinstance(document, list) and len(document) <= 40:
        for index, value in enumerate(document):
            yield from values(value, f"{at}[{index}]")
    else:
        yield at, digest(document) if isinstance(document, list) else document


def product(text, folder):
    """The values of a product and of its normal equations, and its id."""
    document = json.loads(text)
    found = dict(values(document))
    equations = os.path.join(folder, document["path"].removesuffix(".toml") + ".neq.json")
    if os.path.exists(equations):
        with open(equations, encoding="utf-8") as file:
            for key, value in json.load(file).items():
                parts = value.items() if key == "sums" else [("", value)]
                found.update({f"equations/{key}/{part}": digest(inner) for part, inner in parts})
    return found, document["id"]


def model(folder, effects):
    path = os.path.join(folder, f"model-{len(effects)}.toml")
    with open(path, "w", encoding="utf-8") as file:
        file.write('[model]\nrevision = "1"\n')
        for effect in effects:
            name, instance = effect.split(":", 1)
            file.write(f'\n[[effect]]\nid = "{name}"\ninstance = "{instance}"\nestimate = true\n')
    return path


def results(program, case, telemetry):
    with tempfile.TemporaryDirectory() as folder:
        def run(file, mission, effects, *more):
            chosen = ["--mission", mission, "--model", model(folder, OFFSETS + effects)]
            return call(program, folder, "run", SCIENCE, telemetry[file], *chosen, "--archive", "a", "--json", *more)

        if case in SIMULATIONS:
            mission, options = SIMULATIONS[case]
            call(program, folder, "simulate", mission, "--out", "s", *options.split())
            files = [os.path.join(root, name) for root, _, names in os.walk(f"{folder}/s") for name in names]
            return {os.path.relpath(file, folder): digest(open(file, "rb").read()) for file in sorted(files)}
        if case.startswith("design"):
            mission = THRUSTERS if case.endswith("thrusters") else MISSION
            return dict(values(json.loads(call(program, folder, "design", mission, "--json"))))
        if case == "accelerometer":
            archive = f"{FIXTURES}/gracefo/gracefo_1A_2023-06-01_RL04.ascii.noLRI.tgz"
            pipeline = f"{FIXTURES}/pipelines/accelerometer.toml"
            return product(call(program, folder, "run", pipeline, archive, "--archive", "a", "--json"), folder)[0]
        if case == "chained":
            middle = "2035-01-01T01:00:00Z"
            first, _ = product(run("2h", MISSION, [], "--until", middle, "--save-state", "state"), folder)
            second, _ = product(run("2h", MISSION, [], "--from", middle, "--load-state", "state"), folder)
            return {f"{half}{key}": value for half, part in [("1", first), ("2", second)] for key, value in part.items()}
        if case == "ladder":
            ids = [product(run("gain", MISSION, effects), folder)[1] for effects in ([], ["mps-gain:sc.y"])]
            return dict(values(json.loads(call(program, folder, "ladder", *ids, "--archive", "a", "--json"))))
        _, file, mission, effects, commands = RUNS[case]
        found, name = product(run(file, mission, effects), folder)
        for command in commands:
            answer = json.loads(call(program, folder, command, name, "--archive", "a", "--json"))
            found.update({f"{command}{key}": value for key, value in values(answer)})
        return found


def main():
    options = [a for a in sys.argv[1:] if a.startswith("--")]
    words = [a for a in sys.argv[1:] if not a.startswith("--")]
    if len(words) < 2:
        raise SystemExit(__doc__)
    before, after = (os.path.abspath(program) for program in words[:2])
    quick = "--quick" in options
    cases = words[2:] or [*RUNS, *SIMULATIONS, *OTHERS]
    cases = [c for c in cases if not (quick and (c in SLOW or c in RUNS and not RUNS[c][0]))]
    differs = False
    with tempfile.TemporaryDirectory() as folder:
        telemetry = {}
        for name, (mission, arguments) in TELEMETRY.items():
            if any(c == "ladder" and name == "gain" or c == "chained" and name == "2h" or c in RUNS and RUNS[c][1] == name for c in cases):
                call(before, folder, "simulate", mission, "--out", name, *arguments.split())
                telemetry[name] = os.path.join(folder, name, "SC1_2035-01-01.mcap")
        for case in cases:
            old, new = results(before, case, telemetry), results(after, case, telemetry)
            wrong = [key for key in old if key in new and old[key] != new[key]]
            lone = sorted(set(old) ^ set(new))
            print(f"{case}: {len(old)} values, {len(wrong)} differ, {len(lone)} on one side alone")
            for key in wrong[:8]:
                print(f"  {key}: {old[key]} -> {new[key]}")
            if lone:
                print("  alone:", ", ".join(lone[:8]))
            differs |= bool(wrong)
    return int(differs)


if __name__ == "__main__":
    sys.exit(main())
