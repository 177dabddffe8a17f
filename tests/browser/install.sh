#!/usr/bin/env bash
# Installs Debian's Chromium and its WebDriver, with which tests/tests/workbench.rs reads the workbench's pages.
set -euo pipefail

if command -v chromium > /dev/null && command -v chromedriver > /dev/null; then
    exit 0
fi
as_root=()
if [ "$(id -u)" != 0 ]; then
    # Without a password: nobody is there to type one while tests run.
    as_root=(sudo -n)
fi
"${as_root[@]}" apt-get update --quiet
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install --quiet --yes --no-install-recommends \
    chromium chromium-driver fonts-dejavu-core
