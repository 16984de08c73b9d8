# Sourced: what an ordinary user does with an installed depthrig. `program` and `python` name them.
. /test/rig.sh
rig_file >"$HOME/rig.toml"
export DEPTHRIG_RUNTIME_DIR=$HOME/runtime

record() { # DATASETS PYTHON: records while Python subscribes, then verifies
    local datasets=$1 python=$2 daemon
    "$program" --version
    "$program" config check "$HOME/rig.toml"
    "$program" run "$HOME/rig.toml" --seconds 12 --record "$datasets" >"$HOME/daemon.log" 2>&1 &
    daemon=$!
    if ! timeout 60 bash -c 'until "$0" status --json >/dev/null 2>&1; do sleep 0.2; done' "$program"; then
        cat "$HOME/daemon.log" >&2
        return 1
    fi
    [ -z "$python" ] || "$python" /test/subscribe.py
    "$program" open --print | grep --only-matching 'http://localhost:[0-9]*/#token='
    # 3: finished, but sets were lost, which a busy computer may do.
    local status=0
    wait "$daemon" || status=$?
    if [ "$status" -ne 0 ] && [ "$status" -ne 3 ]; then
        cat "$HOME/daemon.log" >&2
        return 1
    fi
    python3 /test/losses.py "$program" "$datasets"/*
    "$program" info "$datasets"/* | head -5
}
