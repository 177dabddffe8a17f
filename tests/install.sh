#!/usr/bin/env bash
# Installs Debian packages with programs that tests drive, where one of the programs is missing:
# install.sh PROGRAM... -- PACKAGE...
set -euo pipefail

missing=0
while [ "$1" != -- ]; do
    command -v "$1" > /dev/null || missing=1
    shift
done
shift
[ $missing = 1 ] || exit 0
as_root=()
if [ "$(id -u)" != 0 ]; then
    # Without a password: nobody is there to type one while tests run.
    as_root=(sudo -n)
fi
# Whoever installs something at the same time is waited for.
wait=(-o DPkg::Lock::Timeout=300)
"${as_root[@]}" apt-get "${wait[@]}" update --quiet
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get "${wait[@]}" install --quiet --yes --no-install-recommends "$@"
