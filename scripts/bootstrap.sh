#!/usr/bin/env bash
# Creates .venv with everything in constraints.txt, once, and again when one of the files that describe it has changed.
#
#   scripts/bootstrap.sh             make .venv ready; a few milliseconds when it already is
#   scripts/bootstrap.sh --print-uv  print the uv to use, installing it into .uv when there is none
#   scripts/bootstrap.sh --browser   see that there is a browser to test pages in: as root on Debian, install its package
#
# PYTHON=/path/to/python names the interpreter to create .venv with; `make clean` first to change that of an old one.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

usable='import sys, venv, ensurepip; assert (3, 12) <= sys.version_info[:2] < (3, 14)'
stamp=.venv/.bhd-stamp

# A company's proxy may sign with a certificate of its own, which the system trusts and uv's own list does not.
for bundle in /etc/ssl/certs/ca-certificates.crt /etc/pki/tls/certs/ca-bundle.crt /etc/ssl/cert.pem; do
    if [ -s "$bundle" ]; then export UV_SYSTEM_CERTS="${UV_SYSTEM_CERTS:-true}" UV_NATIVE_TLS="${UV_NATIVE_TLS:-true}"; fi
done

say() { printf 'bootstrap: %s\n' "$*" >&2; }
die() {
    say "$1"
    shift
    [ $# -eq 0 ] || printf '  %s\n' "$@" >&2
    exit 1
}

# Interpreters, best first, one a line. Some do not run (pyenv puts commands on PATH that fail), so each must be tried.
candidates() {
    local name folder
    for name in python3.12 python3.13 python3 python; do
        type -aP "$name" 2>/dev/null || true
    done
    for name in "$@"; do
        for folder in "${PYENV_ROOT:-$HOME/.pyenv}"/versions/*/bin /usr/local/bin /usr/local/*/bin /opt/*/bin \
            /opt/*/*/bin "$HOME"/.local/bin; do
            if [ -x "$folder/$name" ]; then printf '%s\n' "$folder/$name"; fi
        done
    done
}

# Print the first candidate that runs the given Python statement, from the interpreter's own mouth.
first_python() {
    local test=$1 python
    shift
    while IFS= read -r python; do
        if "$python" -c "$test" </dev/null >/dev/null 2>&1; then
            "$python" -c 'import sys; print(sys.executable)' </dev/null
            return 0
        fi
    done < <(candidates "$@")
    return 1
}

find_uv() {
    local helper
    if uv --version >/dev/null 2>&1; then
        command -v uv
    elif .uv/bin/uv --version >/dev/null 2>&1; then
        printf '%s\n' "$PWD/.uv/bin/uv"
    else
        helper=$(first_python 'import sys, venv, ensurepip; assert sys.version_info >= (3, 8)' \
            python3.12 python3.13 python3 python) || die \
            "there is no uv, and no Python >= 3.8 that can make a virtual environment to install uv into." \
            "Debian, Ubuntu: apt-get install python3 python3-venv" \
            "Fedora:         dnf install python3" \
            "anywhere:       install uv, then run the same command again"
        say "installing uv into .uv with $helper"
        rm -rf .uv
        "$helper" -m venv .uv || die "$helper cannot make a virtual environment." \
            "Debian, Ubuntu: apt-get install python3-venv" "anywhere:       install uv, then run the same command again"
        .uv/bin/python -m pip install --quiet --disable-pip-version-check uv >&2 </dev/null || die \
            "pip could not install uv; its message is above." "Is the package index reachable from this machine?"
        printf '%s\n' "$PWD/.uv/bin/uv"
    fi
}

find_python() {
    local uv=$1
    if [ -n "${PYTHON:-}" ]; then
        "$PYTHON" -c "$usable" </dev/null 2>/dev/null || die \
            "PYTHON=$PYTHON does not run, or is not Python 3.12 or 3.13 with venv and ensurepip."
        printf '%s\n' "$PYTHON"
    elif first_python "$usable" python3.12 python3.13; then
        :
    elif "$uv" python find --no-python-downloads '>=3.12,<3.14' 2>/dev/null; then
        :
    else
        say "no Python 3.12 or 3.13 on this machine; asking uv for one"
        "$uv" python install 3.12 >&2 </dev/null && "$uv" python find '>=3.12,<3.14' || die \
            "found no Python 3.12 or 3.13 that runs, and uv could not fetch one." \
            "Install one (Ubuntu 24.04: apt-get install python3.12 python3.12-venv; pyenv install 3.12)" \
            "or name one: PYTHON=/path/to/python3.12 make test"
    fi
}

fingerprint() {
    pwd
    cksum pyproject.toml constraints.txt scripts/bootstrap.sh bhd_lerobot/__init__.py
}

if [ "${1:-}" = --print-uv ]; then
    find_uv
    exit
fi

if [ "${1:-}" = --browser ]; then
    for name in chromium-headless-shell chromium chromium-browser google-chrome google-chrome-stable; do
        if type -aP "$name" >/dev/null; then exit 0; fi
    done
    if [ "$(id -u)" = 0 ] && type -P apt-get >/dev/null; then
        say "installing Debian's chromium-headless-shell, to test pages in"
        export DEBIAN_FRONTEND=noninteractive
        { apt-get -qq update && apt-get -qq install --no-install-recommends chromium-headless-shell; } \
            </dev/null >/dev/null 2>&1 || say "the package cannot be installed here"
    fi
    exit 0
fi

runs=no
if .venv/bin/python -c "$usable" </dev/null >/dev/null 2>&1; then runs=yes; fi
if [ "$runs" = yes ] && [ "$(cat "$stamp" 2>/dev/null)" = "$(fingerprint)" ]; then exit 0; fi

started=$SECONDS
uv=$(find_uv)
if [ "$runs" = no ]; then
    python=$(find_python "$uv")
    say "creating .venv with $python"
    rm -rf .venv
    "$uv" venv --quiet --no-project --python "$python" .venv
fi
say "installing what constraints.txt lists (with PyTorch, several GB; the first time takes minutes)"
# Compiled once here: where PYTHONDONTWRITEBYTECODE is set, each start would compile LeRobot and all that it imports anew.
VIRTUAL_ENV="$PWD/.venv" "$uv" pip install --quiet --compile-bytecode \
    --constraint constraints.txt --build-constraint constraints.txt \
    --editable '.[test,dev,bench]' </dev/null || die "uv could not install the packages; its message is above." \
    "Is the package index reachable, and is there 8 GB of free disk space?"
fingerprint >"$stamp"
say "ready after $((SECONDS - started)) s"
