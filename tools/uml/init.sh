#!/bin/bash
# The first process inside user-mode-linux: bring vcan0 up, run the command, write its exit status to a file, halt.
# Started by tools/socketcan.sh, which passes SOCKETCAN_WORK (a folder on the host) on the kernel's command line.

work=$SOCKETCAN_WORK
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin

mount -t proc proc /proc
mount -t sysfs sysfs /sys
mkdir -p /dev/pts /dev/shm
mount -t devpts -o ptmxmode=0666,newinstance devpts /dev/pts 2>/dev/null
mount -t tmpfs tmpfs /dev/shm
mount -t tmpfs tmpfs /run
exec >"$work/init.log" 2>&1 </dev/null

end() {
    echo "$1" >"$work/status"
    sync
    [ -n "${SOCKETCAN_NOHALT:-}" ] || halt -f
    echo o >/proc/sysrq-trigger
    sleep 10
}

modules=/usr/lib/uml/modules/$(uname -r)/kernel
for module in net/can/can net/can/can-raw net/can/can-bcm drivers/net/can/dev/can-dev drivers/net/can/vcan \
    drivers/net/can/vxcan drivers/net/can/slcan/slcan; do
    insmod "$modules/$module.ko" || { echo "socketcan: cannot load $module" >&2; end 70; }
done
insmod "$modules/net/can/can-gw.ko" 2>/dev/null # only for measuring: answers frames within the kernel
insmod "$modules/net/sched/sch_netem.ko" 2>/dev/null # only where a test loses, doubles or delays frames
ip link set up lo
ip link add dev vcan0 type vcan && ip link set up vcan0 || end 70
: >"$work/ready"

# The host follows the two files; "sync" has each piece written through to it at once. (A console of
# user-mode-linux passes 20 kB/s and looks like a terminal to the command.)
mkfifo /run/stdout /run/stderr
for stream in stdout stderr; do
    dd if=/run/$stream of="$work/$stream" bs=64k oflag=sync,append conv=notrunc status=none &
done
(
    unset work modules module stream
    # shellcheck disable=SC1090
    source "$SOCKETCAN_WORK/environment"
    cd "$(cat "$SOCKETCAN_WORK/folder")" || exit 70
    export SOCKETCAN_KERNEL=user-mode-linux
    [ ! -e "$SOCKETCAN_WORK/populate.so" ] || export LD_PRELOAD="$SOCKETCAN_WORK/populate.so${LD_PRELOAD:+:$LD_PRELOAD}"
    eval "set -- $(cat "$SOCKETCAN_WORK/command")"
    exec "$@"
) >/run/stdout 2>/run/stderr
status=$?
# Background processes of the command may keep the pipes open, so the wait is limited.
for _ in $(seq 50); do
    [ -n "$(jobs -r)" ] || break
    sleep 0.1
done
end $status
