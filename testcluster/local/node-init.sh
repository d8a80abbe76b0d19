#!/bin/bash
# The first process of a node. It has its own network, mount, host name and process-id namespaces, makes the mounts of a separate
# machine, and starts the node's programs. If it is killed, the kernel kills every process of the node, like a loss of power.
#
# usage: node-init.sh NODE STATE CACHE API_READY HYPERKUBE ENFORCERS_PROCESSORS
set -u
node=$1 state=$2 cache=$3 api_ready=$4 hyperkube=$5 enforcers_processors=$6
log=$state/log

# Sockets, pod logs and plugin folders have fixed paths, so each node needs its own /run, /var/log and /var/lib. The machine's own mounts
# below /run (other runtimes' network namespaces) are unmounted here, or this node would keep them alive.
mount --make-rprivate /
umount --recursive --lazy /run 2>/dev/null
mount -t tmpfs -o mode=755 node /run
mkdir -p /run/understudy /run/netns /run/lock
mount --bind "$cache" /run/understudy
mount -t tmpfs -o mode=755 node /var/lib
if [ ! -d "$state" ]; then
    # The cache itself was below /run or /var/lib.
    mkdir -p "$cache"
    mount --bind /run/understudy "$cache"
fi
mount -t tmpfs -o mode=755 node /var/log
mkdir -p /var/log/pods /var/log/containers /var/lib/cni /var/lib/kubelet
[ ! -e "$state/etc/prepare-enforcer.sh" ] || . "$state/etc/prepare-enforcer.sh"
mount --bind "$state/kubelet" /var/lib/kubelet
hostname "$node"
mount --bind "$state/etc/hosts" /etc/hosts
# The kubelet must see volumes that containers mount, and containers those that the kubelet mounts.
mount --make-rshared /

# Runs a program again whenever it ends, as a service manager does, but not while a file of its name is in `stopped`.
keep() {
    local name=$1
    shift
    while :; do
        while [ -e "$state/stopped/$name" ]; do sleep 0.2; done
        "$@" >>"$log/$name.log" 2>&1
        echo "$name ended with $?; it is started again" >>"$log/$name.log"
        sleep 1
    done &
}

keep containerd containerd --config "$state/etc/containerd.toml"
until ctr version >/dev/null 2>&1; do sleep 0.1; done
# The kubelet doubles its pauses between attempts to register, so it should not start too early.
until [ -e "$api_ready" ] && [ -e /sys/class/net/eth0 ]; do sleep 0.1; done
keep kubelet "$hyperkube" kubelet --config="$state/etc/kubelet.yaml" --kubeconfig="$state/etc/kubelet.conf" \
    --hostname-override="$node" --node-ip="$(<"$state/etc/ip")"
keep kube-proxy "$hyperkube" kube-proxy --config="$state/etc/kube-proxy.yaml"
# If the machine has a cgroup for that, the enforcer's share of the processors is separate from this node's.
keep enforcer bash -c '[ -z "$0" ] || echo $$ >"$0/cgroup.procs"; exec "$@"' "$enforcers_processors" "$state/etc/enforcer.sh"

trap 'exit 0' TERM
# Orphans become children of this process, which must wait for them, or they would stay as zombies.
while :; do wait -n || sleep 1; done
