#!/bin/bash
# Start SLURM, PostgreSQL and an MLflow server on this machine, run the check of a job array, and stop all of it.
#
#     experiments/cluster/check.sh
#
# Without SLURM, the tasks of the array run one after the other; without PostgreSQL, it is left out.
set -euo pipefail

cd "$(dirname "$0")/../.."
export PYTHON=${PYTHON:-$PWD/.venv/bin/python} PYTHONPATH=$PWD
here=experiments/cluster port=${PORT:-5600}
if ! ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1; then
    echo "skipped: PostgreSQL is missing (Debian's postgresql)"
    exit 0
fi
folder=$(mktemp -d)
chmod 755 "$folder"
trap '$here/server.sh stop "$folder/server"; [ ! -v SLURM_CONF ] || $here/slurm.sh stop "$folder/slurm"' EXIT
uri=$($here/server.sh start "$folder/server" "$port" | tail -1)
if [ "$(id -u)" = 0 ] && command -v slurmctld munged >/dev/null; then
    $here/slurm.sh start "$folder/slurm"
    export SLURM_CONF=$folder/slurm/slurm.conf
else
    echo "without SLURM (Debian's slurm-wlm and munge, as root): the tasks run one after the other"
fi
"$PYTHON" -m tests.cluster.array_check "$folder/array" "$uri"
rm -rf "$folder/array"
