#!/bin/sh
# Installs Slurm's controller, node daemon and munge on Debian or Ubuntu, for the tests of the launcher `slurm`.
# No service is started or changed: the tests start daemons of their own, with their own configuration.
set -eu

if command -v sbatch > /dev/null && command -v slurmctld > /dev/null && command -v munged > /dev/null; then
    echo "Slurm is installed already"
    exit 0
fi
if ! command -v apt-get > /dev/null || [ "$(id -u)" != 0 ]; then
    echo "Slurm cannot be installed here: this needs apt-get and the rights of root; its tests will be skipped" >&2
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive RUNLEVEL=1
apt-get install --yes --quiet --no-install-recommends munge slurm-wlm
