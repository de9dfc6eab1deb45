#!/usr/bin/env bash
# Lints the Dockerfile; builds it and runs a small demo inside where that can be done without an engine.
#
# buildah builds and runs with chroot isolation: no daemon, no privileged container. The base image
# comes from a registry, or, where none is reachable, is made of Debian's own packages.
set -euo pipefail
cd "$(dirname "$0")/.."
BASE=python:3.11-slim-bookworm
PULL_S=60 BASE_S=600 BUILD_S=1200 RUN_S=600 # limits by the clock: 41 minutes at the very most
NEEDED_GB=12                                # two stages, each a full copy; 7 GB when measured

say() { printf 'container: %s\n' "$*"; }
skip() {
    say "BUILD SKIPPED: $*"
    exit 0
}

uv run hadolint Dockerfile
say "Dockerfile: nothing to complain about"

[ "$(uname -s)" = Linux ] || skip "buildah runs on Linux"
[ "$(id -u)" = 0 ] || skip "not root: a base image and files of other users cannot be made here"
if ! command -v buildah >/dev/null || ! command -v debootstrap >/dev/null; then
    timeout "$BASE_S" env DEBIAN_FRONTEND=noninteractive sh -c \
        'apt-get update -q && apt-get install -qy --no-install-recommends buildah debootstrap' \
        >/dev/null 2>&1 || skip "neither buildah and debootstrap nor a way to install them"
fi

work=$(mktemp -d "${TMPDIR:-/var/tmp}/realsim_container.XXXXXX")
export TMPDIR=$work # also buildah's caches
b() { timeout "$1" buildah --root "$work/store" --runroot "$work/run" --storage-driver vfs "${@:2}"; }
trap 'rm -rf "$work"' EXIT # vfs mounts nothing
free_gb=$(df --output=avail -BG "$work" | tail -n 1 | tr -dc 0-9)
[ "$free_gb" -ge "$NEEDED_GB" ] || skip "$free_gb GB are free under $work, $NEEDED_GB GB are needed"
build() { b "$1" bud --isolation chroot --layers=false --pull-never "${@:2}" >"$work/log" 2>&1; }

# --- the base image, trusting whom this machine trusts: its network may have an authority of its own
mkdir "$work/base"
cp /etc/ssl/certs/ca-certificates.crt "$work/base/"
if b "$PULL_S" pull -q "docker.io/library/$BASE" >/dev/null 2>&1; then
    say "base image: from the registry"
    printf 'FROM docker.io/library/%s\n' "$BASE" >"$work/base/Dockerfile"
else
    say "base image: no registry is reachable; made of Debian's packages instead"
    timeout "$BASE_S" debootstrap --variant=minbase --include=ca-certificates,python3,python3-pip \
        bookworm "$work/root" >"$work/log" 2>&1 || skip "no registry and no mirror of Debian: $(tail -n 1 "$work/log")"
    rm -f "$work"/root/var/cache/apt/archives/*.deb "$work"/root/usr/lib/python3.11/EXTERNALLY-MANAGED
    ln -s /usr/bin/python3.11 "$work/root/usr/local/bin/python"
    tar -C "$work/root" -cf "$work/base/root.tar" .
    rm -rf "$work/root"
    printf 'FROM scratch\nADD root.tar /\n' >"$work/base/Dockerfile"
fi
cat >>"$work/base/Dockerfile" <<'END'
COPY ca-certificates.crt /etc/ssl/certs/ca-certificates.crt
ENV SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt PIP_CERT=/etc/ssl/certs/ca-certificates.crt
END
build "$BASE_S" -f "$work/base/Dockerfile" -t "localhost/$BASE" "$work/base" || { cat "$work/log"; exit 1; }
rm -rf "$work/base"

# --- the image
began=$SECONDS
build "$BUILD_S" -f Dockerfile -t localhost/realsim . || { tail -n 60 "$work/log"; exit 1; }
say "built in $((SECONDS - began)) s"

# --- in it: as its own user, with what its libraries find in it and nothing else
container=$(b 120 from --isolation chroot --pull-never localhost/realsim)
inside() { b "$RUN_S" run --isolation chroot "$container" -- "$@"; }
inside realsim --version
inside realsim doctor
[ "$(inside id -u)" = 10001 ] || { say "it runs as another user than 10001"; exit 1; }
inside sh -c '! touch /opt/realsim/x 2>/dev/null' || { say "its own program can be changed"; exit 1; }
left=$(b "$RUN_S" run --isolation chroot --user 0 "$container" -- find / -xdev -path /proc -prune -o \( -path '/var/lib/apt/lists/*' -o -name '*.deb' \
    -o -path '/root/.cache/*' \) -print)
[ -z "$left" ] || { say "caches are left in the image: $left"; exit 1; }
began=$SECONDS
inside realsim demo --views 8 --objects 2 --grasps 10 --quiet
inside test -s /data/demo/session/reports/report.html
say "a small demo ran inside in $((SECONDS - began)) s; $(du -sh "$work/store" | cut -f1) of storage, removed again"
