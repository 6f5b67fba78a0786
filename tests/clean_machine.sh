#!/usr/bin/env bash
# Proves that the README's first command works on a fresh Debian 12: makes one in a chroot (needs root and
# debootstrap), copies the committed project in, and runs apps/demo.sh there.
# MIRROR names another Debian mirror.
set -euo pipefail
cd "$(dirname "$0")/.."

if [ "$(id -u)" -ne 0 ] || ! command -v debootstrap >/dev/null; then
    echo "clean_machine.sh: needs root and the package debootstrap" >&2
    exit 1
fi
root=$(mktemp -d)
chmod 755 "$root"
cleanup() {
    umount "$root/proc" 2>/dev/null || true
    rm -rf "$root"
}
trap cleanup EXIT

debootstrap --variant=minbase bookworm "$root" ${MIRROR:+"$MIRROR"} >"$root.log" 2>&1 ||
    { tail -n 20 "$root.log" >&2; exit 1; }
cp /etc/resolv.conf "$root/etc/resolv.conf"
cp /etc/apt/apt.conf.d/*proxy* "$root/etc/apt/apt.conf.d/" 2>/dev/null || true
mount -t proc proc "$root/proc"
mkdir -p "$root/home/new/libtrack"
git archive HEAD | tar -x -C "$root/home/new/libtrack"
chroot "$root" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/home/new LANG=C.UTF-8 \
    ${http_proxy:+http_proxy="$http_proxy"} /home/new/libtrack/apps/demo.sh
picture=$root/home/new/libtrack/demo-output/cloud.png
[ "$(head -c 4 "$picture" | tail -c 3)" = PNG ]
echo "clean_machine.sh: a fresh Debian 12 reached its picture ($(stat -c %s "$picture") bytes)"
