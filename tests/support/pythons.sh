#!/bin/bash
# pythons.sh PYTHON...: what `make test` has that needs no wall clock, on each of these interpreters that is on this
# machine: on the PATH, in pyenv or in uv's own folder. PYTEST_ARGS: how.
set -euo pipefail
tried=0
for name; do
    for python in "$name" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/*/bin/"$name" "$(uv python dir)"/*/bin/"$name"; do
        "$python" -c '' 2>/dev/null && break
        python=
    done
    if [ -z "$python" ]; then
        echo "$name: not on this machine"
        continue
    fi
    place=build/pythons/$name
    "$python" -m venv "$place"
    uv pip install --quiet --python "$place/bin/python" -c constraints.txt -e '.[test]'
    echo "$name: $("$place/bin/python" --version)"
    "$place/bin/python" -m pytest -q -m "not soak and not system and not long and not edges and not guest and not real_time" ${PYTEST_ARGS:--n 2}
    tried=$((tried + 1))
done
[ "$tried" -gt 0 ]
