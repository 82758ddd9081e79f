#!/bin/bash
# In the guest, on the host's file system: bring vcan0 up, run the command, write its exit status to a file.
work=/run/job
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
ip link set up lo
ip link add dev vcan0 type vcan && ip link set up vcan0 || exit
ulimit -l unlimited -r 99
(
    # shellcheck disable=SC1091
    source "$work/environment"
    cd "$(cat /run/job/folder)" || exit 70
    eval "set -- $(cat /run/job/command)"
    exec "$@"
) >>"$work/stdout" 2>>"$work/stderr" </dev/null
echo $? >"$work/status"
