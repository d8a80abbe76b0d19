# Part of node-init.sh on a node with Cilium: mounts for the sources that the agent compiles, its plugin beside `loopback`, and its maps.
program=$state/etc/cilium-program
mkdir -p /var/lib/cilium/bpf /run/cilium /run/cilium-cni
mount --bind "$program/bpf" /var/lib/cilium/bpf
cp "$program/cilium-cni" /usr/lib/cni/loopback /usr/lib/cni/portmap /run/cilium-cni/
# Each mount is a file system of its own, so nodes do not see each other's maps, and a loss of power ends them.
mount -t bpf bpf /sys/fs/bpf
# These two settings belong to the whole machine, and the agent would write them. It finds them as it wants them, and leaves them alone.
for setting in unprivileged_bpf_disabled:1 timer_migration:0; do
    echo "${setting#*:}" >"/run/cilium-${setting%:*}"
    mount --bind "/run/cilium-${setting%:*}" "/proc/sys/kernel/${setting%:*}"
done
