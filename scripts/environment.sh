# Sourced by the other scripts: the virtual environment .venv with the pinned packages, made or brought up to date.
# Needs nothing but a Python of 3.11 or newer.

set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# several small problems side by side are faster than one on several threads
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"

find_python() {
    local name
    for name in python3.13 python3.12 python3.11 python3 python; do
        if "$name" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
            echo "$name"
            return
        fi
    done
    echo "No Python of 3.11, 3.12 or 3.13 with venv was found; install one (Debian: apt install python3 python3-venv)." >&2
    return 1
}

# prepare_environment [EXTRAS]: EXTRAS such as [test]; does nothing when the environment is up to date
prepare_environment() {
    local extras="${1:-}" python stamp
    if [ ! -x .venv/bin/python ]; then
        python=$(find_python)
        echo "Making .venv with $("$python" --version)" >&2
        "$python" -m venv .venv
    fi
    # the absolute place counts too: a moved folder leaves an environment that points elsewhere
    stamp=$(cat pyproject.toml constraints.txt <(pwd -P) | .venv/bin/python -c 'import hashlib, sys; print(hashlib.sha256(sys.stdin.buffer.read()).hexdigest())')
    if [ "$(cat .venv/installed-test 2>/dev/null || true)" = "$stamp" ]; then return; fi
    if [ -z "$extras" ] && [ "$(cat .venv/installed 2>/dev/null || true)" = "$stamp" ]; then return; fi
    echo "Installing packages into .venv (some minutes the first time)" >&2
    .venv/bin/python -m pip install --quiet --use-pep517 --disable-pip-version-check -c constraints.txt -e ".$extras"
    if [ -n "$extras" ]; then echo "$stamp" > .venv/installed-test; else echo "$stamp" > .venv/installed; fi
}

# prepare_browser: CHROMIUM is the program of a Chromium or Chrome; Debian's is installed where there is none
prepare_browser() {
    local name sudo=""
    if [ -x "${CHROMIUM:-}" ]; then return; fi
    for name in chromium chromium-browser google-chrome google-chrome-stable; do
        if CHROMIUM=$(command -v "$name"); then export CHROMIUM; return; fi
    done
    if [ "$(id -u)" != 0 ]; then sudo="sudo -n"; fi
    if { $sudo apt-get update -qq && $sudo apt-get install -qq -y --no-install-recommends chromium; } >/dev/null 2>&1; then
        CHROMIUM=$(command -v chromium); export CHROMIUM; return
    fi
    echo "The tests of the report need a Chromium: install one (Debian: apt install chromium), or name its program in CHROMIUM." >&2
    return 1
}
