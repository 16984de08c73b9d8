# Sourced by tools/test.sh when it is run by root: the ordinary user that the tests run as.
# Sets DEPTHRIG_TEST_USER and DEPTHRIG_TEST_OPEN, which tests/runner/box.py reads.
if [ -z "${DEPTHRIG_TEST_USER:-}" ]; then
    account=depthrig-test
    if ! id "$account" >/dev/null 2>&1; then
        useradd --system --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin "$account" ||
            echo "no account $account: the tests run as user 61234, which has none" >&2
    fi
    uid=$(id --user "$account" 2>/dev/null || echo 61234)
    gid=$(id --group "$account" 2>/dev/null || echo 61234)
    export DEPTHRIG_TEST_USER=$uid:$gid:$home
fi
IFS=: read -r uid gid _ <<<"$DEPTHRIG_TEST_USER"
chown -R "$uid:$gid" "$home"
# Caches that tests keep between runs: seeded weights, the virtual machine's kernel.
chmod 1777 "$target/tmp"
mkdir -p "$target/test-cache"
chown "$uid:$gid" "$target/test-cache"
export DEPTHRIG_TEST_CACHE=$target/test-cache
# Interpreters may lie in a folder of root's, as the clone itself may.
open=$PWD:$target:$DEPTHRIG_TEST_DATA:$HOME/.pyenv
for interpreter in .venv*/bin/python; do
    [ ! -x "$interpreter" ] || open+=:$("$interpreter" -c 'import sys; print(sys.base_prefix)')
done
export DEPTHRIG_TEST_OPEN=$open
if ! tests/runner/box.py -- test -r Makefile -a -r "$target/debug"; then
    echo "user $uid, which the tests run as, cannot read $PWD or $target: make them readable (chmod -R a+rX)" >&2
    exit 1
fi
