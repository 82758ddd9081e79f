#!/usr/bin/env bash
# Print the path of a Chromium for the tests of the live page. If there is none and the user is root, Debian's
# headless shell is installed, which needs no desktop libraries and starts faster.
#
# Exit status: 0, or 69 with the reason on standard error if no Chromium is available.
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
