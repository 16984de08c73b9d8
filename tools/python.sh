#!/usr/bin/env bash
# Tests the Python package as users get it: builds the source archive, from it the wheel, and runs the tests.
#
#   tools/python.sh environments   the environments of the tests below
#   tools/python.sh types      the types alone; 77 before the environments are there
#   tools/python.sh versions   types, then the wheel's tests on every Python from 3.9 on that this computer has
#   tools/python.sh torch      the tests that need PyTorch, with that of .venv-lerobot; 77 when it is not there
#   tools/python.sh lab        the tests of depthrig.lab, with the same PyTorch; 77 when it is not there
#   tools/python.sh run-lab MODULE ARGUMENT...   a module of depthrig.lab, such as depthrig.lab.train, with the same
#   tools/python.sh oak        the OAK bridge with the vendor's SDK in .venv-oak: tests, and types against its stubs; 77
#                              when it is not there
#
# Looked for are python3.9, python3.10, … and pyenv's; DEPTHRIG_PYTHONS="3.9 3.13" chooses. Environments are created once,
# in target/python. The tests start a publisher: DEPTHRIG_TEST_PUBLISHER, else cargo builds it.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
# The caller creates the environments; tests run as an ordinary user (tests/runner/box.py).
box() { "$root/tests/runner/box.py" --limit 3600 -- "$@"; }
envs=${CARGO_TARGET_DIR:-$PWD/target}/python

interpreter() { # VERSION: the path of a Python of that version that can make environments
    local candidate
    for candidate in "$(command -v "python$1" || true)" "$HOME/.pyenv/versions/$1".*/bin/python; do
        [ -x "$candidate" ] || continue
        if "$candidate" -c "import ensurepip, sys, venv; sys.exit('%d.%d' % sys.version_info[:2] != '$1')" 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    return 1
}

environment() { # NAME PYTHON REQUIREMENT...: an environment with these, created once
    local folder=$envs/$1 python=$2
    shift 2
    local wanted
    wanted="$("$python" -V) $* $(cat python/pyproject.toml python/requirements-test.txt)"
    if [ "$(cat "$folder/.stamp" 2>/dev/null)" != "$wanted" ]; then
        tools/environment.sh "$folder" "$python" "$@"
        printf '%s\n' "$wanted" >"$folder/.stamp"
    fi
}

pip=("$envs/tools/bin/python" -m pip --disable-pip-version-check)
# The type checker, the build and the one pip, which need a newer Python than the package.
tools() {
    local version python
    python=$(for version in 3.14 3.13 3.12 3.11; do interpreter "$version" && break; done)
    environment tools "$python" pip==25.3 build==1.6.1 mypy==2.4.1 numpy==2.4.6 'iceoryx2==0.10.*'
}

found=()
# Finds the Pythons and creates their environments.
environments() {
    local wanted=${DEPTHRIG_PYTHONS:-3.9 3.10 3.11 3.12 3.13 3.14} version
    for version in $wanted; do
        if interpreter "$version" >/dev/null; then found+=("$version"); fi
    done
    [ ${#found[@]} -gt 0 ] || { echo "no Python of $wanted was found" >&2; return 1; }
    tools
    for version in "${found[@]}"; do
        environment "$version" "$(interpreter "$version")" --requirement python/requirements-test.txt \
            'iceoryx2==0.10.*' 'numpy>=1.21'
    done
    echo "found: ${found[*]}; not there: $(comm -23 <(tr ' ' '\n' <<<"$wanted" | sort) <(printf '%s\n' "${found[@]}" | sort) | tr '\n' ' ')"
}

types() {
    [ -e "$envs/tools/.stamp" ] || { echo "Python types are not checked: make environments puts mypy there"; return 77; }
    "$envs/tools/bin/mypy" --config-file python/pyproject.toml --cache-dir "$envs/mypy" python/src
}

versions() {
    local version failed=""
    environments
    types
    rm -rf "$envs/dist"
    "$envs/tools/bin/python" -m build --outdir "$envs/dist" python >"$envs/build.log" 2>&1 || { cat "$envs/build.log"; return 1; }
    rm -rf python/build
    local wheel
    wheel=$(echo "$envs"/dist/depthrig-*-py3-none-any.whl)
    tar --list --file "$envs"/dist/depthrig-*.tar.gz --wildcards '*/src/depthrig/py.typed' >/dev/null

    # Two at once: they wait more than they compute.
    rm -f "$envs"/*.failed
    for version in "${found[@]}"; do
        [ "$(jobs -rp | wc -l)" -lt 2 ] || wait -n || true
        (test_version "$version" "$wheel" || touch "$envs/$version.failed") >"$envs/$version.log" 2>&1 &
    done
    wait
    for version in "${found[@]}"; do
        cat "$envs/$version.log"
        [ ! -e "$envs/$version.failed" ] || failed+=" $version"
    done
    [ -z "$failed" ] || { echo "failed on Python$failed" >&2; return 1; }
}

test_version() { # VERSION WHEEL: each line with &&, because this is called where errors do not end the script
    local of=$envs/$1
    "${pip[@]}" --python "$of" install --quiet --force-reinstall --no-deps "$2" && "${pip[@]}" --python "$of" check &&
        # Not from the folder python/, where the package lies as source.
        cd / && "$of/bin/python" -c 'import depthrig, pathlib, sys
folder = pathlib.Path(depthrig.__file__).parent
assert "site-packages" in str(folder) and (folder / "py.typed").exists(), folder
print("==", sys.version.split()[0], "from", folder.relative_to(sys.prefix))' &&
        box "$of/bin/python" -m pytest --quiet --config-file "$root/python/pyproject.toml" \
            --rootdir "$root/python" -p no:cacheprovider "$root/python/tests"
}

# Makes the folder of python/requirements-NAME.txt beside the PyTorch of .venv-lerobot.
beside() { # NAME
    local name=$1 python=$PWD/.venv-lerobot/bin/python
    if ! "$python" -c 'import torch' 2>/dev/null; then
        echo "PyTorch is not in .venv-lerobot; make test puts it there"
        return 77
    fi
    # Beside PyTorch's environment, not into it: that one is LeRobot's, version by version.
    local beside=$envs/beside-$name requirements=python/requirements-$name.txt
    if [ ! -e "$beside/.stamp" ] || [ "$requirements" -nt "$beside/.stamp" ]; then
        rm -rf "$beside"
        tools
        "${pip[@]}" --python "$python" install --quiet --no-deps --target "$beside" --requirement "$requirements"
        touch "$beside/.stamp"
    fi
}

with_torch() { # NAME TEST...: tests with the PyTorch of .venv-lerobot and python/requirements-NAME.txt
    local name=$1
    shift
    beside "$name" || return
    PYTHONPATH=$PWD/python/src:$envs/beside-$name box "$PWD/.venv-lerobot/bin/python" -m pytest --quiet \
        -p no:cacheprovider "$@"
}

torch() { with_torch torch python/tests/test_torch.py python/tests/test_policy.py; }

# One thread: other steps run beside it, and threads of OpenMP would spin.
lab() {
    if ! .venv-lerobot/bin/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        echo "depthrig.lab needs Python 3.11 in .venv-lerobot"
        return 77
    fi
    OMP_NUM_THREADS=1 with_torch lab tests/lab
}

# One thread: sums have one order, so that a run has the same bits wherever it is interrupted.
run-lab() { # MODULE ARGUMENT...
    beside lab
    OMP_NUM_THREADS=1 PYTHONPATH=$PWD/python/src:$envs/beside-lab .venv-lerobot/bin/python -m "$@"
}

oak() {
    local python=$PWD/.venv-oak/bin/python
    if ! "$python" -c 'import depthai' >/dev/null 2>&1; then
        echo "the OAK SDK is not in .venv-oak; make test puts it there"
        return 77
    fi
    # Without a camera the calls that only a camera answers are held against the SDK's own stubs.
    PYTHONPATH=$PWD/python/src "$python" -m mypy --config-file python/pyproject.toml --cache-dir "$envs/mypy-oak" \
        python/src/depthrig
    PYTHONPATH=$PWD/python/src box "$python" -m pytest --quiet -p no:cacheprovider \
        python/tests/test_oak.py python/tests/test_oak_parts.py
}

case ${1:-} in
environments | types | versions | torch | lab | oak) "$1" ;;
run-lab) "$@" ;;
*)
    sed -n '2,14s/^# \{0,1\}//p' "$0" >&2
    exit 2
    ;;
esac
