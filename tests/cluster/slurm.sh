#!/usr/bin/env bash
# A SLURM cluster of one node, this machine, to try studies on: packages slurm-wlm and munge of Debian, as root.
#
#   tests/cluster/slurm.sh up      # then snakemake --executor slurm ..., sinfo, squeue
#   tests/cluster/slurm.sh down
#
# No cgroups, no accounting, no systemd: it works in a container too. Its files are in $SLURM_TEST (/run/tasklens-slurm).
set -euo pipefail
folder=${SLURM_TEST:-/run/tasklens-slurm}
export SLURM_CONF=$folder/slurm.conf

down() {
    # Jobs outlive their daemons, and the node that was set down.
    for step in $(pgrep -x slurmstepd || true); do
        for job in $(pgrep -P "$step" || true); do kill -KILL -- "-$job" 2> /dev/null || true; done
    done
    for name in slurmd slurmctld munged; do
        if [[ -f $folder/$name.pid ]]; then kill "$(cat "$folder/$name.pid")" 2> /dev/null || true; fi
    done
    for _ in $(seq 50); do
        pgrep -F "$folder/slurmctld.pid" > /dev/null 2>&1 || break
        sleep 0.1
    done
    if [[ -L /etc/slurm/slurm.conf ]]; then rm /etc/slurm/slurm.conf; fi
    rm -rf "$folder"
}

up() {
    if [[ -f /etc/slurm/slurm.conf && ! -L /etc/slurm/slurm.conf ]]; then
        echo "/etc/slurm/slurm.conf: this machine has a cluster already" >&2
        return 2
    fi
    down
    mkdir -p "$folder"/{state,spool,munge}
    chmod 755 "$folder" "$folder/munge"
    memory=$(awk '/MemTotal/ {print int($2 / 1024 * 0.9)}' /proc/meminfo)
    cat > "$SLURM_CONF" << END
ClusterName=tasklens
SlurmctldHost=$(hostname -s)(127.0.0.1)
AuthType=auth/munge
AuthInfo=socket=$folder/munge/socket
CredType=cred/munge
SlurmUser=root
SlurmctldPort=16817
SlurmdPort=16818
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
# jobs over their memory end, as on a cluster with cgroups; looked at every second
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/none
# squeue knows ended jobs for so long [s]: there is no accounting
MinJobAge=3600
KillWait=5
InactiveLimit=0
ReturnToService=2
SchedulerParameters=sched_interval=1,batch_sched_delay=0
NodeName=$(hostname -s) NodeAddr=127.0.0.1 CPUs=$(getconf _NPROCESSORS_ONLN) RealMemory=$memory State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
END
    mkdir -p /etc/slurm
    ln -s "$SLURM_CONF" /etc/slurm/slurm.conf # srun inside of a job looks nowhere else
    dd if=/dev/urandom bs=1 count=1024 of="$folder/munge/key" 2> /dev/null
    chmod 600 "$folder/munge/key"
    munged --force --key-file="$folder/munge/key" --socket="$folder/munge/socket" --pid-file="$folder/munged.pid" \
        --log-file="$folder/munge/log" --seed-file="$folder/munge/seed"
    slurmctld -f "$SLURM_CONF"
    slurmd -f "$SLURM_CONF"
    for _ in $(seq 100); do
        if [[ $(sinfo -h -o %T 2> /dev/null) == idle ]]; then
            return
        fi
        sleep 0.2
    done
    tail -n 20 "$folder"/slurm*.log >&2
    return 1
}

"${1:?up or down}"
