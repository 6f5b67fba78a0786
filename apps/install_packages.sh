#!/usr/bin/env bash
# Installs the Debian packages that are missing: those to build with, and with "test" those to test with.
set -euo pipefail

packages=(g++ cmake ninja-build libopenvdb-dev libtbb-dev libboost-iostreams-dev
          libboost-program-options-dev libopenexr-dev libimath-dev libpng-dev nlohmann-json3-dev
          zlib1g-dev libblosc-dev)
if [ "${1:-}" = test ]; then
    packages+=(libgtest-dev libbenchmark-dev clang-format ccache git libopenvdb-tools libnanovdb-dev
               clang libclang-rt-dev nodejs)
fi

missing=()
for package in "${packages[@]}"; do
    if [ "$(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null)" != installed ]; then
        missing+=("$package")
    fi
done
if [ ${#missing[@]} -eq 0 ]; then
    exit 0
fi
if ! command -v apt-get >/dev/null; then
    echo "These Debian packages are missing, and there is no apt-get here: ${missing[*]}" >&2
    exit 1
fi
sudo=()
if [ "$(id -u)" -ne 0 ]; then
    sudo=(sudo)
fi
echo "Installing Debian packages: ${missing[*]}"
export DEBIAN_FRONTEND=noninteractive
"${sudo[@]}" apt-get -qq update
"${sudo[@]}" apt-get -qq install -y --no-install-recommends "${missing[@]}" >/dev/null
