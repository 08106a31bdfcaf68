#!/bin/bash
# Start or stop SLURM with one node, this machine, on 127.0.0.1; needs root, and Debian's slurm-wlm and munge.
#
#     experiments/cluster/slurm.sh start FOLDER    # then: export SLURM_CONF=FOLDER/slurm.conf
#     experiments/cluster/slurm.sh stop FOLDER
#
# FOLDER keeps the configuration, the state, the key and the logs. TASKS is the number of tasks at a time; by default
# that of the cores. The node needs no cgroups, so that this works in a container.
set -euo pipefail

action=${1:?start or stop} folder=$(realpath -m "${2:?a folder}")
export SLURM_CONF=$folder/slurm.conf

start() {
    mkdir -p "$folder"/{state,spool,munge}
    cores=$(nproc) memory=$(($(awk '/^MemTotal/ {print $2}' /proc/meminfo) / 1024))
    chmod 755 "$folder"
    chmod 700 "$folder/munge"
    [ -e "$folder/munge/key" ] || mungekey --create --keyfile "$folder/munge/key"
    chmod 755 "$folder/munge"
    munged --force --key-file "$folder/munge/key" --socket "$folder/munge/socket" --pid-file "$folder/munge/pid" \
        --log-file "$folder/munge/log" --seed-file "$folder/munge/seed"
    cat >"$SLURM_CONF" <<CONFIGURATION
ClusterName=skin
SlurmctldHost=$(hostname -s)(127.0.0.1)
SlurmctldPort=${PORT:-6817}
SlurmdPort=$((${PORT:-6817} + 1))
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge/socket
CredType=cred/munge
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=sched_interval=2
ReturnToService=2
SlurmdParameters=config_overrides
MinJobAge=86400
NodeName=$(hostname -s) NodeAddr=127.0.0.1 CPUs=${TASKS:-$cores} RealMemory=$memory State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONFIGURATION
    slurmctld
    slurmd
    for _ in $(seq 60); do
        if sinfo --noheader --format=%t 2>/dev/null | grep --quiet idle; then
            echo "export SLURM_CONF=$SLURM_CONF"
            return
        fi
        sleep 1
    done
    echo "the node is not idle: see $folder/slurmctld.log and $folder/slurmd.log" >&2
    exit 1
}

stop() {
    for name in slurmd.pid slurmctld.pid munge/pid; do
        [ ! -e "$folder/$name" ] || kill "$(cat "$folder/$name")" 2>/dev/null || true
    done
}

"$action"
