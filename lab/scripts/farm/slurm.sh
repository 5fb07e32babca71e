#!/usr/bin/env bash
# Starts and stops Slurm with four one-processor nodes on this host, without systemd, for tests and bars of `entire
# farm`.
#
#   slurm.sh start FOLDER      prints the path of slurm.conf, for SLURM_CONF
#   slurm.sh stop FOLDER       returns once the daemons have ended; those that run on after 20 s are killed
#
# Needs root, slurmctld, slurmd and munged (Debian: slurm-wlm, munge). Keys, sockets, logs and state are in FOLDER.
set -euo pipefail
what=${1:?start or stop}
folder=$(realpath -m "${2:?a folder}")

# runs PID: true if the process runs; false for a process that has ended and was not waited for (a zombie)
runs() { grep -q '^State:[[:space:]]*[^XZ]' "/proc/$1/status" 2>/dev/null; }

# ended SECONDS PID…: waits until all processes have ended; fails if one still runs after SECONDS
ended() {
    local end=$((SECONDS + $1)) pid
    for pid in "${@:2}"; do
        while runs "$pid"; do
            ((SECONDS < end)) || return 1
            sleep 0.1
        done
    done
}

stop() {
    local file pid pids=()
    for file in "$folder"/*.pid; do
        pid=$(cat "$file" 2>/dev/null) && [[ -n $pid ]] || continue
        pids+=("$pid")
        kill "$pid" 2>/dev/null || true
    done
    ended 20 "${pids[@]}" && return
    kill -9 "${pids[@]}" 2>/dev/null || true
    ended 5 "${pids[@]}" || echo "slurm.sh: a daemon does not end" >&2
}

if [[ $what == stop ]]; then
    stop
    exit 0
fi
for name in slurmctld slurmd munged sbatch squeue; do
    command -v "$name" >/dev/null || { echo "slurm.sh: no $name (apt-get install slurm-wlm munge)" >&2; exit 3; }
done
[[ $(id -u) == 0 ]] || { echo "slurm.sh: only root can start it (run it with sudo)" >&2; exit 3; }
mkdir -p "$folder/spool" "$folder/state"
host=$(hostname)
(umask 077 && head -c 1024 /dev/urandom >"$folder/munge.key")
munged --force --key-file="$folder/munge.key" --socket="$folder/munge.socket" --pid-file="$folder/munge.pid" \
    --log-file="$folder/munge.log" --seed-file="$folder/munge.seed" 2>"$folder/munge.err" || { cat "$folder/munge.err" >&2; exit 1; }
port=$((20000 + RANDOM % 20000))
cat >"$folder/slurm.conf" <<CONF
ClusterName=farm
SlurmctldHost=$host
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge.socket
CryptoType=crypto/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerType=sched/backfill
SchedulerParameters=batch_sched_delay=0,bf_interval=1
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool/%n
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd-%n.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd-%n.log
SlurmctldPort=$port
ReturnToService=2
MpiDefault=none
NodeName=n[1-4] NodeHostname=$host NodeAddr=127.0.0.1 Port=[$((port + 1))-$((port + 4))] CPUs=1 State=UNKNOWN
PartitionName=main Nodes=n[1-4] Default=YES MaxTime=60 State=UP
CONF
export SLURM_CONF=$folder/slurm.conf
slurmctld -f "$SLURM_CONF"
stepd=$(command -v slurmstepd || echo /usr/sbin/slurmstepd)
for i in 1 2 3 4; do slurmd -f "$SLURM_CONF" -N "n$i" -d "$stepd"; done
for _ in $(seq 80); do
    [[ $(sinfo -h -N -t idle -o %N 2>/dev/null | wc -l) == 4 ]] && { echo "$SLURM_CONF"; exit 0; }
    sleep 0.25
done
echo "slurm.sh: the nodes did not come up; see $folder/slurmctld.log" >&2
stop
exit 1
