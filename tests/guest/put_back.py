"""Takes back the fixes of what a trial on the kernel's drivers once found, and shows that the guest notices each.

`python -m tests.guest.put_back [F1 F2 F3 F4]` changes a copy of this checkout, never the checkout itself, and runs the
tests in the guest against it, which boots once. Ends with 1 if one of them stays green. The soak does the same with
the tests on terminals (tests/reverts).
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.reverts.adapters import REVERTS
from tests.reverts.revert import copy_of_checkout, outcomes, taken_back


def main() -> int:
    """Take the named fixes back together; return 1 if one of them is not missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("fault", nargs="*", help="which; all if none is named")
    names = parser.parse_args().fault or [each.finding for each in REVERTS]
    chosen = [each for each in REVERTS if each.finding in names]
    with tempfile.TemporaryDirectory(prefix="ldcnd-put-back-") as place:
        copy = copy_of_checkout(Path(place))
        with taken_back(copy, *chosen):
            found = outcomes(copy, "-m", "guest", "tests/guest", "-k", " or ".join(each.guest for each in chosen))
    silent = []
    for each in chosen:
        noticed = [test for test, outcome in found.items() if each.guest in test and outcome == "failed"]
        print(f"{each.finding}: {each.what}\n  " + "\n  ".join(noticed or ["nothing noticed it"]))
        silent += [] if noticed else [each.finding]
    print(f"not noticed: {', '.join(silent)}" if silent else "each was noticed")
    return 1 if silent else 0


if __name__ == "__main__":
    sys.exit(main())
