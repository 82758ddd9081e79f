#!/usr/bin/env bash
# Print the path of a Chromium for the tests of the live page; Debian's is installed where there is none and we are root:
# its shell without windows, which comes without a desktop's libraries and begins sooner.
#
# Exit status: 0, or 69 and the reason on standard error when there is none to be had.
set -u
for name in chromium-headless-shell chromium chromium-browser google-chrome; do
    if command -v "$name"; then exit 0; fi
done
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
    echo "chromium: there is none on this machine: install Debian's package chromium" >&2
    exit 69
fi
{
    export DEBIAN_FRONTEND=noninteractive
    apt-get update -qq && {
        apt-get install -y -qq --no-install-recommends chromium-headless-shell fonts-dejavu-core ||
            apt-get install -y -qq --no-install-recommends chromium fonts-dejavu-core
    }
} >/dev/null 2>&1
command -v chromium-headless-shell || command -v chromium && exit 0
echo "chromium: Debian's package chromium cannot be installed here" >&2
exit 69
