"""Does the tasks of a campaign on a Dask cluster: dask_driver.py DIR [--scheduler ADDRESS] [--commit]

DIR is a folder with a plan, made by `dragfree campaign plan`, that all workers see under the same name; every worker
needs the `dragfree` that planned it on its PATH. Without an address, two workers are started on this machine. The
scheduler keeps nothing that matters: whatever is killed, the next run does what has no result yet.
"""

import argparse
import json
import os
import pathlib
import subprocess

import dask
from dask.distributed import Client, LocalCluster, as_completed

# Workers that are started here look at their own stack a hundred times a second, which tells nothing of a program that
# they wait for, and takes its time.
QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.worker.memory.monitor-interval": "10s",
}


def do(argv, *_results_before):
    """One task: its command, with the error text where it fails. A worker has one core for it.

    Dask has its workers give memory back at once (MALLOC_TRIM_THRESHOLD_), which costs a program a tenth of its time.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    words = [*argv, "--quiet", "--json", "--threads", "1"]
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip())
    return json.loads(done.stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--scheduler", help="address of a scheduler, tcp://host:8786")
    parser.add_argument("--commit", action="store_true", help="take the results over at the end")
    arguments = parser.parse_args()
    dask.config.set(QUIET)
    cluster = arguments.scheduler or LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with Client(cluster) as client:
        futures = {}
        for line in (arguments.folder / "plan.jsonl").read_text().splitlines():
            task = json.loads(line)
            # The key is the task's id: two clients that submit one plan do each task once.
            before = [futures[id] for id in task["after"]]
            futures[task["id"]] = client.submit(do, task["argv"], *before, key=task["id"], retries=3, pure=True)
        for count, (_, result) in enumerate(as_completed(futures.values(), with_results=True), 1):
            print(f"{count} of {len(futures)}  {result['id']}  {result['digest']}", flush=True)
    if arguments.commit:
        subprocess.run(["dragfree", "campaign", "commit", arguments.folder], check=True)


if __name__ == "__main__":
    main()
