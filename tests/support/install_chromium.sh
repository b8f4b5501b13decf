#!/bin/sh
# Installs Chromium on Debian or Ubuntu, for the tests of the browser pages.
set -eu

if [ -n "${MAREY_TEST_CHROMIUM:-}" ] || command -v chromium > /dev/null; then
    echo "Chromium is installed already"
    exit 0
fi
if ! command -v apt-get > /dev/null || [ "$(id -u)" != 0 ]; then
    echo "Chromium cannot be installed here: this needs apt-get and the rights of root; its tests will be left out and counted" >&2
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive
apt-get install --yes --quiet --no-install-recommends chromium ||
    echo "Chromium could not be installed, see above; its tests will be left out and counted" >&2
