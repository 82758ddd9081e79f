#!/usr/bin/env bash
# Run a command with the SocketCAN interface vcan0 up, on this machine's kernel or in user-mode-linux.
#
#   tools/socketcan.sh [--timeout SECONDS] [--uml] [--realtime] [--slowed N] [--check] COMMAND [ARGUMENT...]
#
# The command runs in the current folder with the current environment; its standard output, standard error and
# exit status are passed through; its standard input is empty. In this order:
#   1. If vcan0 exists and is up, the command simply runs.
#   2. If the kernel has vcan and the user may add interfaces, vcan0 is created, and removed afterwards.
#   3. Otherwise Debian's user-mode-linux (a Linux kernel that runs as a process, with the CAN modules that the
#      host lacks) boots on this machine's own file system. It has one CPU: suitable for tests of function and
#      faults, but not of timing below 4 ms. Missing Debian packages are installed if the user is root. If there
#      is a C compiler, tools/uml/*.c are compiled and preloaded; without them, user-mode-linux does not boot on
#      processors with AMX. In addition, tools/uml/guest/populate.c is preloaded for the command: with it, Python
#      takes three quarters of the time to load.
#
#   --timeout SECONDS   end everything after this time (default 3600); exit status 124
#   --uml               use user-mode-linux even if the kernel has vcan
#   --realtime          give user-mode-linux real-time priority (SCHED_RR, as root): a system call then costs 16 us
#                       instead of 25 to 70, but two at once leave a small machine no time for other processes
#   --slowed N          for tests of function: in user-mode-linux (preferred if available, even if the kernel has vcan),
#                       time passes N times as slowly while any process computes, and idle time is skipped, so that
#                       other load on this machine does not affect the command; see tools/uml/guest_clock.c
#   --check             run nothing: exit status 0 if one of the ways above is possible; otherwise 69, with the reason
#
# Exit status: the command's own; 124 after the time-out; 69 if no SocketCAN is available, also if user-mode-linux does
# not boot on this machine; 70 if user-mode-linux booted but ended before the command did.
# SOCKETCAN_MEMORY (default 1G) is the memory of user-mode-linux; SOCKETCAN_LOCKS (default /tmp/socketcan-UID) is the
# prefix of the lock files by which concurrent runs share the processors.
set -u

readonly here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
readonly unavailable=69 broken=70 timed_out=124
readonly packages=(user-mode-linux kmod iproute2 can-utils)
readonly boot_limit_s=120 # it takes 2 s
locks=${SOCKETCAN_LOCKS:-/tmp/socketcan-$(id -u)} && readonly locks
limit_s=3600 force_uml=no check_only=no realtime=no slowed=''

say() { echo "socketcan: $*" >&2; }

while [ $# -gt 0 ]; do
    case $1 in
        --timeout) limit_s=${2:?--timeout needs seconds}; shift 2 ;;
        --timeout=*) limit_s=${1#*=}; shift ;;
        --uml) force_uml=yes; shift ;;
        --realtime) realtime=yes; shift ;;
        --slowed) slowed=${2:?--slowed needs a number}; shift 2 ;;
        --check) check_only=yes; shift ;;
        --) shift; break ;;
        -*) say "unknown option $1"; exit 2 ;;
        *) break ;;
    esac
done
if [ $# -eq 0 ] && [ $check_only = no ]; then
    sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "$0" >&2
    exit 2
fi

as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@" 2>/dev/null; fi; }
interface_is_up() { [ "$(cat /sys/class/net/vcan0/type 2>/dev/null)" = 280 ] && ip link show vcan0 2>/dev/null | grep -q '[<,]UP[,>]'; }

make_native() {
    command -v ip >/dev/null || return 1
    as_root modprobe vcan >/dev/null 2>&1 || true
    as_root ip link add dev vcan0 type vcan >/dev/null 2>&1 || return 1
    as_root ip link set up vcan0 >/dev/null 2>&1 || { as_root ip link delete vcan0; return 1; }
}

uml_is_complete() {
    local program
    for program in linux.uml insmod ip candump; do command -v $program >/dev/null || return 1; done
    find /usr/lib/uml/modules -name vcan.ko 2>/dev/null | grep -q .
}

install_uml() {
    local held status
    exec {held}>"$locks-install.lock"
    flock "$held" # of two that begin at once, the second finds them installed
    install_packages
    status=$?
    exec {held}>&-
    return $status
}

install_packages() {
    uml_is_complete && return 0
    if [ "$(id -u)" != 0 ]; then say "needs root to install: apt-get install ${packages[*]}"; return 1; fi
    if ! command -v apt-get >/dev/null; then say "no apt-get here to install ${packages[*]}"; return 1; fi
    say "installing ${packages[*]}"
    { apt-get install -qy --no-install-recommends "${packages[@]}" ||
        { apt-get update -q && apt-get install -qy --no-install-recommends "${packages[@]}"; }
    } >"$work/apt.log" 2>&1 </dev/null || { tail -n 5 "$work/apt.log" >&2; say "apt-get could not install them"; return 1; }
    uml_is_complete || { say "user-mode-linux is still incomplete after installation"; return 1; }
}

# Prints the path of the library to preload for user-mode-linux; nothing if it cannot be compiled.
compile_preload() {
    local without="user-mode-linux is tried as it is: not on processors with AMX, and with the machine's own time"
    if ! command -v cc >/dev/null; then
        say "no C compiler (cc): $without"
    elif cc -O2 -shared -fPIC -o "$work/preload.so" "$here"/uml/*.c -ldl 2>"$work/cc.log"; then
        echo "$work/preload.so"
    else
        head -n 3 "$work/cc.log" >&2
        say "cc could not compile tools/uml/*.c: $without"
    fi
}

# Sets `processor` to a given one that no other user-mode-linux of this script uses; to any of them if all are in use.
take_processor() {
    local each held
    for each in "$@"; do
        exec {held}>"$locks-processor-$each.lock"
        if flock --nonblock "$held"; then processor=$each; return; fi # held until this script ends
        exec {held}>&-
    done
    local all=("$@")
    processor=${all[$$ % $#]}
}

# Compiles the library that speeds up Python in user-mode-linux; Python works without it, too.
compile_for_guest() {
    cc -O2 -shared -fPIC -o "$work/populate.so" "$here/uml/guest/populate.c" 2>/dev/null
}

# Runs in a session of its own, so that one signal to the group ends user-mode-linux and every process in it.
run_uml() {
    export -p | grep -vE '^declare -[a-zA-Z]*r' >"$work/environment"
    printf '%q ' "$@" >"$work/command"
    pwd >"$work/folder"
    : >"$work/stdout" >"$work/stderr"
    # The command line of a kernel cannot contain a path with spaces.
    cp "$here/uml/init.sh" "$work/init.sh"
    # user-mode-linux and its processes switch at each system call, which is cheapest on a single processor.
    local first=() processors
    mapfile -t processors < <(taskset -pc $$ | sed 's/.*: *//' | tr ',' '\n' |
        while IFS=- read -r from to; do seq "$from" "${to:-$from}"; done)
    if [ ${#processors[@]} -gt 0 ]; then
        take_processor "${processors[@]}"
        first=(taskset -c "$processor")
    fi
    [ $realtime = yes ] && chrt --rr 1 true 2>/dev/null && first+=(chrt --rr 1)
    local preload
    preload=$(compile_preload)
    compile_for_guest
    setsid "${first[@]}" env ${preload:+"LD_PRELOAD=$preload"} "UML_CLOCK_SLOWED=$slowed" "UML_CLOCK_SLOWED_FROM=$work/ready" linux.uml \
        "mem=${SOCKETCAN_MEMORY:-1G}" root=/dev/root rootfstype=hostfs rootflags=/ rw "init=$work/init.sh" "SOCKETCAN_WORK=$work" "uml_dir=$work/" umid=uml \
        con=null con0=null,fd:1 ssl=null quiet \
        >"$work/boot.log" 2>&1 </dev/null &
    uml=$!
    tail -q -n +1 -f -s 0.1 --pid=$uml "$work/stdout" &
    local followers=$!
    tail -q -n +1 -f -s 0.1 --pid=$uml "$work/stderr" >&2 &
    followers+=" $!"
    local deadline=$((SECONDS + limit_s)) boot_deadline=$((SECONDS + boot_limit_s)) status=$broken
    while kill -0 $uml 2>/dev/null; do
        if [ ! -e "$work/ready" ] && [ $SECONDS -ge $boot_deadline ]; then
            say "user-mode-linux was not ready after $boot_limit_s s"
            break
        fi
        if [ $SECONDS -ge $deadline ]; then
            say "not finished after $limit_s s: ended"
            end_uml
            # shellcheck disable=SC2086
            wait $followers
            return $timed_out
        fi
        sleep 0.1
    done
    end_uml
    # shellcheck disable=SC2086
    wait $followers
    if [ ! -e "$work/ready" ]; then
        tail -qn 15 "$work/boot.log" "$work/init.log" >&2 2>/dev/null
        say "user-mode-linux does not boot here (its last words are above)"
        status=$unavailable
    elif [ -s "$work/status" ]; then
        status=$(cat "$work/status")
    else
        say "user-mode-linux ended without running the command to its end:"
        tail -qn 15 "$work/boot.log" "$work/init.log" >&2
    fi
    return "$status"
}

end_uml() {
    [ -n "${uml:-}" ] || return 0
    kill -KILL -- "-$uml" 2>/dev/null
    wait "$uml" 2>/dev/null
    uml=
}

finish() {
    end_uml
    [ "${made_native:-no}" = no ] || as_root ip link delete vcan0 2>/dev/null
    [ -z "${work:-}" ] || rm -rf "$work"
}
trap finish EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP

native() {
    interface_is_up && return 0
    make_native && made_native=yes
}

uml() {
    if [ "$(uname -s)-$(uname -m)" != Linux-x86_64 ]; then
        say "user-mode-linux is for Linux on x86-64 only"
        return $unavailable
    fi
    work=$(mktemp -d /tmp/socketcan.XXXXXX) || return $broken
    install_uml || return $unavailable
    if [ $check_only = yes ]; then say "vcan0: user-mode-linux"; else run_uml "$@"; fi
}

here() {
    if [ $check_only = yes ]; then say "vcan0: this kernel's"; else timeout --kill-after=5 "$limit_s" "$@" </dev/null; fi
}

made_native=no work=
if [ $force_uml = no ] && [ -z "$slowed" ] && native; then
    here "$@"
    exit $?
fi
uml "$@"
status=$?
if [ $status -eq $unavailable ] && [ ! -e "$work/ready" ]; then
    # In user-mode-linux, concurrent tests have separate kernels; on this kernel they take turns on the interface.
    if [ $force_uml = no ] && [ -n "$slowed" ] && exec {turn}>"$locks-native.lock" && flock "$turn" && native; then
        say "with this kernel's vcan instead, and with this machine's time"
        here "$@"
        exit $?
    fi
    say "no SocketCAN to be had: this kernel has no vcan, and user-mode-linux is not to be had either"
fi
exit $status
