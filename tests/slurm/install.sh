#!/usr/bin/env bash
# Installs Debian's Slurm, with which tests/tests/campaigns.rs does the tasks of a campaign.
set -euo pipefail

if command -v slurmctld > /dev/null && command -v slurmd > /dev/null && command -v sbatch > /dev/null; then
    exit 0
fi
as_root=()
if [ "$(id -u)" != 0 ]; then
    # Without a password: nobody is there to type one while tests run.
    as_root=(sudo -n)
fi
"${as_root[@]}" apt-get update --quiet
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install --quiet --yes --no-install-recommends \
    slurmctld slurmd slurm-client
