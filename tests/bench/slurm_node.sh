#!/bin/bash
# Run a Slurm with one node in a folder until stdin closes: `slurm_node.sh FOLDER PORT PORT`. Needs slurm-wlm and munge.
set -e
home=$1
host=$(hostname -s)
mkdir -p "$home"/{state,spool}
dd if=/dev/urandom of="$home/munge.key" bs=64 count=1 status=none
chmod 400 "$home/munge.key"
cat > "$home/slurm.conf" <<CONF
ClusterName=alone
SlurmctldHost=$host(127.0.0.1)
SlurmUser=$(id -un)
AuthInfo=socket=$home/munge.socket
CredType=cred/munge
StateSaveLocation=$home/state
SlurmdSpoolDir=$home/spool
SlurmctldPidFile=$home/slurmctld.pid
SlurmdPidFile=$home/slurmd.pid
SlurmctldLogFile=$home/slurmctld.log
SlurmdLogFile=$home/slurmd.log
SlurmctldPort=$2
SlurmdPort=$3
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_min_interval=0
ReturnToService=2
MailProg=/bin/true
NodeName=$host NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
export SLURM_CONF=$home/slurm.conf
/usr/sbin/munged -F --force --key-file="$home/munge.key" --socket="$home/munge.socket" --pid-file="$home/munged.pid" \
    --log-file="$home/munged.log" --seed-file="$home/munged.seed" &
munge=$!
/usr/sbin/slurmctld -D -c &
control=$!
trap 'kill $control $node $munge 2>/dev/null; wait' EXIT
sleep 1
/usr/sbin/slurmd -D &
node=$!
cat > /dev/null
