#!/bin/sh
# pythons.sh PYTHON...: the tests that need no wall clock, on each of these interpreters that is there.
set -eu
tried=0
for python in "$@"; do
    if ! "$python" -c '' 2>/dev/null; then
        echo "$python: not on this machine"
        continue
    fi
    place=build/pythons/$(basename "$python")
    "$python" -m venv "$place"
    uv pip install --quiet --python "$place/bin/python" -c constraints.txt -e '.[test]'
    echo "$python: $("$place/bin/python" --version)"
    "$place/bin/python" -m pytest -q -m "not soak and not edges and not real_time" ${PYTEST_ARGS:-}
    tried=$((tried + 1))
done
[ "$tried" -gt 0 ]
