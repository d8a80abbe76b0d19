# Shared by the scripts in this folder: source it from bash. The scripts write everything to the cache and nothing to the repository.
# shellcheck shell=bash

REPOSITORY=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
CACHE=${XDG_CACHE_HOME:-$HOME/.cache}/understudy
mkdir -p "$CACHE/log"

# kubectl and helm, if the machine has none or older ones.
export PATH=$CACHE/tools:$PATH
# The package is imported from the clone and never installed, because clones that need the same packages share one environment.
export PYTHONPATH=$REPOSITORY/operator${PYTHONPATH:+:$PYTHONPATH}
# Bytecode goes to the cache too. Without it, each process that a test starts would compile whatever it imports.
unset PYTHONDONTWRITEBYTECODE
export PYTHONPYCACHEPREFIX=$CACHE/bytecode
# The ROS wheels set these once per process tree; a child process with another environment would load the wrong libraries.
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH
export RMW_IMPLEMENTATION=rmw_fastrtps_cpp

_started=$(date +%s)

# say TEXT: prints a line for people, with the seconds since the start.
say() {
    printf '[%5d s] %s\n' $(($(date +%s) - _started)) "$*"
}

# fail TEXT: prints an error and ends with status 1.
fail() {
    printf '%s: %s\n' "$(basename "$0")" "$*" >&2
    exit 1
}

# quietly NAME COMMAND...: runs a command and writes its output to a log. If the command fails, prints the end of the log.
quietly() {
    local log=$CACHE/log/$1.log
    shift
    "$@" >"$log" 2>&1 || {
        tail -n 40 "$log" >&2
        printf '%s failed; all of its output: %s\n' "$*" "$log" >&2
        return 1
    }
}

# debian_packages PACKAGE...: installs the packages that are missing.
debian_packages() {
    local missing=() package
    for package in "$@"; do
        [ "$(dpkg-query -W -f '${Status}' "$package" 2>/dev/null)" = "install ok installed" ] || missing+=("$package")
    done
    [ ${#missing[@]} -eq 0 ] && return
    local root=()
    if [ "$(id -u)" -ne 0 ]; then
        command -v sudo >/dev/null || fail "these packages are missing: ${missing[*]}; install them as root: apt-get install ${missing[*]}"
        root=(sudo)
    fi
    say "installing ${missing[*]}"
    quietly apt-update "${root[@]}" apt-get update -q
    quietly apt-install "${root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends "${missing[@]}"
}

# debian_programs PROGRAM=PACKAGE...: installs the packages of the programs that are missing. Does nothing without apt-get or the right
# to use it: then whatever needs a missing program reports it.
debian_programs() {
    local missing=() pair
    for pair in "$@"; do
        PATH=$PATH:/usr/sbin:/sbin command -v "${pair%%=*}" >/dev/null || missing+=("${pair#*=}")
    done
    [ ${#missing[@]} -eq 0 ] && return
    command -v apt-get >/dev/null || return 0
    [ "$(id -u)" -eq 0 ] || command -v sudo >/dev/null || return 0
    debian_packages "${missing[@]}"
}

# rendering_libraries: installs the libraries that render images without a display and a graphics card. Does nothing without apt-get or
# the right to use it: then whatever needs a missing library reports it.
rendering_libraries() {
    command -v apt-get >/dev/null || return 0
    [ "$(id -u)" -eq 0 ] || command -v sudo >/dev/null || return 0
    debian_packages libegl1 libgl1-mesa-dri libopengl0
}

# interface_wheels FOLDER: builds the ROS interface packages of the examples into a folder, once.
interface_wheels() {
    [ -e "$1/.complete" ] && return
    # Environments with other packages use the same wheels, so another run may be building them.
    exec 8>"$1.lock"
    flock 8
    [ -e "$1/.complete" ] && return
    debian_programs cmake=cmake g++=g++ make=make
    "$base" -c 'import os, sys, sysconfig; sys.exit(not os.path.exists(sysconfig.get_path("include") + "/Python.h"))' ||
        debian_packages python3-dev
    say "building the interfaces of the examples in $1 (two minutes, once)"
    rm -rf "$1"
    "$base" -m venv "$1/environment"
    quietly interfaces "$base" "$REPOSITORY/examples/navigation/interfaces/build" --environment "$1/environment" --out "$1"
    rm -rf "$1/environment"
    touch "$1/.complete"
    exec 8>&-
}

# python_environment: makes the Python environment for development (once for each set of packages), and sets PYTHON to its interpreter.
python_environment() {
    local base=/usr/bin/python3 wanted folder interfaces
    [ -x "$base" ] || { command -v apt-get >/dev/null && debian_packages python3; }
    [ -x "$base" ] || base=$(command -v python3) || fail "there is no python3: install Python 3.11 or newer"
    "$base" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail "$("$base" --version) is too old: Python 3.11 or newer is needed"
    local requirements=("$base" "$REPOSITORY/docker/requirements.py" "$REPOSITORY")
    # The examples' interfaces depend on the versions that they are built against; the environment depends on both.
    wanted=$(cd "$REPOSITORY/examples/navigation/interfaces" && find . -type f -not -name '*.md' | LC_ALL=C sort |
        xargs sha256sum | cat - <("$base" --version) | sha256sum | cut -c 1-12)
    interfaces=$CACHE/interfaces-$wanted
    # What is installed decides, and not what else is in constraints.txt.
    wanted=$("${requirements[@]}" operator ros dev) || fail "constraints.txt does not suit pyproject.toml"
    wanted=$({ echo "$wanted" "$interfaces" && "$base" --version; } | sha256sum | cut -c 1-12)
    folder=$CACHE/venv-$wanted
    PYTHON=$folder/bin/python
    export PYTHON
    [ -e "$folder/.complete" ] && return
    "$base" -c 'import ensurepip, venv' 2>/dev/null || debian_packages python3-venv
    # Another run may be making the same environment.
    exec 9>"$folder.lock"
    flock 9
    if [ ! -e "$folder/.complete" ]; then
        interface_wheels "$interfaces"
        say "making a Python environment in $folder (two minutes, once)"
        rm -rf "$folder"
        "$base" -m venv "$folder"
        "${requirements[@]}" --build >"$folder/build.txt"
        "${requirements[@]}" operator ros dev >"$folder/requirements.txt"
        quietly pip-build "$folder/bin/pip" install --disable-pip-version-check --require-hashes --requirement "$folder/build.txt"
        # Packages without a wheel are built with what was just installed: pip would fetch other tools, without their hashes.
        quietly pip "$folder/bin/pip" install --disable-pip-version-check --use-pep517 --no-build-isolation \
            --require-hashes --requirement "$folder/requirements.txt"
        quietly pip-interfaces "$folder/bin/pip" install --disable-pip-version-check --no-index --no-deps "$interfaces"/*.whl
        touch "$folder/.complete"
    fi
    exec 9>&-
}

# go_program NAME SOURCE PACKAGE [VARIABLE=VALUE...]: builds a program from the Go module in the folder SOURCE into $CACHE/tools,
# unless it was built before. The variables are set for `go build`.
go_program() {
    (cd "$REPOSITORY" && "$PYTHON" - "$CACHE/tools" "$@") <<'PYTHON'
import sys
from pathlib import Path

from testcluster import golang
from testcluster.progress import Progress

tools, name, source, package, *variables = Path(sys.argv[1]), *sys.argv[2:]
env = dict(variable.split("=", 1) for variable in variables)
built = golang.build(name, Path(source).resolve(), [package], ["-ldflags=-s -w"], Progress(), "one to five minutes, once", env)
tools.mkdir(exist_ok=True)
(tools / name).unlink(missing_ok=True)
(tools / name).symlink_to(built / name)
PYTHON
}

# helm_program: builds helm if the machine has none from version 3.17 on (--take-ownership). `scripts/cluster up` builds one too.
helm_program() {
    local found
    found=$(helm version --template '{{.Version}}' 2>/dev/null | sed 's/^v//') || found=
    [ "$(printf '%s\n' 3.17 "${found:-0}" | sort -V | head -n 1)" = 3.17 ] && return
    say "building helm, since there is ${found:-none}${found:+, which is too old}"
    go_program helm testcluster/local/hyperkube helm.sh/helm/v3/cmd/helm
}

# chart_programs: builds what tests of the chart and of manifests need besides helm: helm-unittest, and kubeconform with its schemas.
chart_programs() {
    local source=tests/unit/chart/programs
    go_program helm-unittest "$source" github.com/helm-unittest/helm-unittest/cmd/helm-unittest &&
        go_program kubeconform "$source" github.com/yannh/kubeconform/cmd/kubeconform &&
        (cd "$REPOSITORY" && "$PYTHON" -m tests.support.schemas)
}

# vale_program: builds Vale, the prose linter. It has parts in C. If the machine's Go is too old for Vale, Go fetches a newer one.
vale_program() {
    debian_programs gcc=gcc g++=g++
    go_program vale scripts/vale github.com/vale-cli/vale/v3/cmd/vale CGO_ENABLED=1 GOTOOLCHAIN=auto
}
