#!/bin/bash
# As an ordinary user of a clean system: the Debian package.
set -Eeuo pipefail
trap 'echo "failed: $BASH_COMMAND" >&2' ERR
cd
program=/usr/bin/depthrig
. /test/use.sh
record deb-datasets ""

man --pager=cat depthrig-run | grep -q 'DEPTHRIG-RUN(1)\|depthrig-run(1)'
bash -c '. /usr/share/bash-completion/completions/depthrig
    COMP_WORDS=(depthrig ver); COMP_CWORD=1
    _depthrig depthrig ver depthrig
    [[ " ${COMPREPLY[*]} " = *" verify "* ]]'
[ "$(zsh -fc 'autoload -U compinit; compinit -u -D; print $_comps[depthrig]')" = _depthrig ]
fish -c 'complete --do-complete "depthrig ver"' | grep -q '^verify'
echo "manual page; completions of bash, zsh and fish"

installed=$("$program" install --print)
grep -c 'installed by the package' <<<"$installed" | grep -qx 2
echo "deb: installed, recorded, verified"
