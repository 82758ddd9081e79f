#!/usr/bin/env bash
# Run a command on a PREEMPT_RT kernel whose clock counts instructions, with the SocketCAN interface vcan0 up.
#
#   tools/realtime/run.sh [--timeout SECONDS] COMMAND [ARGUMENT...]
#
# Debian's own PREEMPT_RT kernel boots in QEMU, on this machine's file system, with one processor that is emulated: each
# instruction takes one nanosecond of the guest's time (-icount shift=0), and idle time is skipped. Load on this machine
# therefore does not affect the guest's timing: any delay in the guest has its cause in the guest, and a microsecond is a
# thousand instructions, so commits can be compared. It is slow: the command starts after a minute, and then runs ten
# times slower than on this machine.
#
# Output and exit status are the command's; it runs in the current folder with the current environment.
# Needs root and apt to install missing packages: QEMU, busybox, cpio, kmod, can-utils, iproute2 and the kernel (70 MB, kept in
# build/realtime).
# Exit status: the command's own; 69 if kernel or programs are not available; 70 if the guest did not run the command;
# 124 after the time-out.
set -u

readonly here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
readonly kept=$here/../../build/realtime flavour=rt-amd64
readonly unavailable=69 broken=70 timed_out=124
limit_s=3600

say() { echo "realtime: $*" >&2; }

if [ "${1:-}" = --timeout ]; then limit_s=$2; shift 2; fi
if [ $# -eq 0 ]; then sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "$0" >&2; exit 2; fi

install_programs() {
    local program missing=()
    for program in qemu-system-x86_64:qemu-system-x86 busybox:busybox-static cpio:cpio depmod:kmod cangw:can-utils ip:iproute2; do
        command -v "${program%%:*}" >/dev/null || missing+=("${program#*:}")
    done
    [ ${#missing[@]} -gt 0 ] || return 0
    say "installing ${missing[*]}"
    apt-get install -qy --no-install-recommends "${missing[@]}" >>"$kept/apt.log" 2>&1 </dev/null ||
        { apt-get update -q && apt-get install -qy --no-install-recommends "${missing[@]}"; } >>"$kept/apt.log" 2>&1 </dev/null
}

fetch_kernel() {
    ls "$kept"/linux-image-*.deb >/dev/null 2>&1 && return 0
    local package
    package=$(apt-cache search --names-only "^linux-image-[0-9.]+-[0-9]+-$flavour\$" | cut -d' ' -f1 | sort -V | tail -n 1)
    [ -n "$package" ] || { say "apt knows no linux-image-*-$flavour"; return 1; }
    say "fetching $package"
    (cd "$kept" && apt-get -o APT::Sandbox::User=root download "$package") >>"$kept/apt.log" 2>&1
}

# The kernel, and a file system for its start: busybox, the modules in the order of their dependencies, and init.
unpack_kernel() {
    [ "$kept/initramfs" -nt "$here/init" ] && return 0
    local tree=$kept/unpacked name version
    rm -rf "$tree" && mkdir -p "$tree/start/modules" "$tree"/start/{bin,proc,host} || return 1
    dpkg-deb --fsys-tarfile "$kept"/linux-image-*.deb | tar -x -C "$tree" ./boot ./lib/modules || return 1
    cp "$tree"/boot/vmlinuz-* "$kept/vmlinuz"
    version=$(basename "$tree"/lib/modules/*)
    depmod -b "$tree" "$version"
    for name in virtio_pci virtio-rng 9pnet_virtio 9p can can-raw can-gw vcan; do
        modprobe -d "$tree" -S "$version" --show-depends "$name" | awk '$1 == "insmod" { print $2 }'
    done | awk '!seen[$0]++' | while read -r name; do
        cp "$name" "$tree/start/modules/"
        basename "$name"
    done >"$tree/start/modules/order"
    cp "$(command -v busybox)" "$tree/start/bin/busybox"
    install -m 755 "$here/init" "$tree/start/init"
    (cd "$tree/start" && find . | cpio -o -H newc --quiet | gzip -1) >"$kept/initramfs.new" || return 1
    rm -rf "$tree"
    mv "$kept/initramfs.new" "$kept/initramfs"
}

mkdir -p "$kept"
install_programs && fetch_kernel && unpack_kernel >>"$kept/apt.log" 2>&1 || { tail -n 5 "$kept/apt.log" >&2; say "not to be had"; exit $unavailable; }

qemu='' followers=''
finish() {
    # shellcheck disable=SC2086
    [ -z "$qemu$followers" ] || kill -KILL $qemu $followers 2>/dev/null
    rm -rf "$work"
}
work=$(mktemp -d /tmp/realtime.XXXXXX) || exit $broken
trap finish EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP
export -p | grep -vE '^declare -[a-zA-Z]*r' >"$work/environment"
printf '%q ' "$@" >"$work/command"
pwd >"$work/folder"
: >"$work/stdout" >"$work/stderr"
cp "$here/guest.sh" "$work/"
qemu-system-x86_64 -M q35 -accel tcg,thread=single -cpu max -icount shift=0,sleep=off,align=off -smp 1 -m 1G \
    -nodefaults -no-user-config -display none -no-reboot -kernel "$kept/vmlinuz" -initrd "$kept/initramfs" \
    -append "console=ttyS0 quiet panic=-1 mitigations=off nokaslr" -serial "file:$work/console" \
    -fsdev local,id=root,path=/,security_model=none,multidevs=remap -device virtio-9p-pci,fsdev=root,mount_tag=root \
    -fsdev "local,id=work,path=$work,security_model=none" -device virtio-9p-pci,fsdev=work,mount_tag=work \
    </dev/null >"$work/qemu" 2>&1 &
qemu=$!
tail -q -n +1 -f -s 0.1 --pid=$qemu "$work/stdout" &
followers=$!
tail -q -n +1 -f -s 0.1 --pid=$qemu "$work/stderr" >&2 &
followers+=" $!"
deadline=$((SECONDS + limit_s))
while kill -0 $qemu 2>/dev/null; do
    [ $SECONDS -lt $deadline ] || { say "not finished after $limit_s s: ended"; exit $timed_out; }
    sleep 0.1
done
# shellcheck disable=SC2086
wait $followers
qemu='' followers=''
[ -s "$work/status" ] && exit "$(cat "$work/status")"
say "the guest ended without running the command to its end:"
tail -qn 15 "$work/qemu" "$work/console" >&2
exit $broken
