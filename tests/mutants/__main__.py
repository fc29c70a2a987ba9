"""`python -m tests.mutants`: change safety-relevant code in so many seeded ways, print what no test notices."""

import argparse
import os
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tests.mutants.campaign import KILLED, Campaign, Judgement, Verdict, run
from tests.mutants.changes import Mutant, mutants_of
from tests.mutants.covering import ROOT, Covering, record

SUBJECTS = (
    "ldcnd/axis/*.py", "ldcnd/axis/procedures/*.py",
    *(f"ldcnd/daemon/{name}.py" for name in (
        "dispatch", "group_moves", "interlocks", "leases", "ledger", "line", "modules", "rig", "rig_commands",
    )),
    *(f"ldcnd/line/{name}.py" for name in (
        "bus", "exchange", "line", "proof", "schedule", "settings",
    )),
    *(f"ldcnd/drives/ldcn/{name}.py" for name in (
        "access", "addressing", "adoption", "commands", "controls", "faults", "gathering", "groups", "homing",
        "io_module", "network", "packet", "path", "received", "record", "registers", "servo", "trajectory",
    )),
    *(f"ldcnd/drives/smartstep/{name}.py" for name in (
        "commands", "drive", "ledger", "modes", "monitors", "network", "packet", "parameter_store", "parameters",
        "trace", "trace_check", "trace_result", "transfer", "words",
    )),
    "ldcnd/client/own_samples.py", "ldcnd/contract/condition.py", "ldcnd/contract/number_text.py",
    "ldcnd/net/hand_over.py", "ldcnd/net/reads.py",
)  # fmt: skip
"""Admission, authority, ledger, guards, planner, tracker, policies, procedures, lines, status decoding, parameters."""
TESTS = ("tests/unit", "tests/property", "tests/integration", "tests/fuzz", "tests/drivers")
EQUIVALENTS = Path(__file__).with_name("equivalents.toml")
REQUIRED = 0.95


def main() -> int:
    """Run a campaign; return 1 if too few are killed, one is not judged, or one lives and is not argued for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300, help="how many mutants; 0 for all")
    parser.add_argument("--seed", type=int, default=18)
    parser.add_argument("--minutes", type=float, default=240.0, help="no mutant is begun after this time")
    parser.add_argument("--seconds", type=float, default=30.0, help="of tests for one mutant")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--tests", nargs="+", default=TESTS, help="which tests")
    parser.add_argument(
        "--subjects", nargs="+", default=SUBJECTS, help="which modules are changed, or functions: PATH::Class.function"
    )
    parser.add_argument("--recorded", action="store_true", help="use the recorded coverage as it is")
    parser.add_argument("--anew", action="store_true", help="judge also what the same test has killed before")
    options = parser.parse_args()

    ends_s = time.monotonic() + 60 * options.minutes
    if not options.recorded:
        record(options.tests)
    candidates = mutants_in(options.subjects)
    paths = sorted({mutant.path for mutant in candidates})
    count = min(options.count or len(candidates), len(candidates))
    mutants = sorted(candidates, key=lambda mutant: mutant.rank(options.seed))[:count]
    print(f"seed {options.seed}: {count} of {len(candidates)} mutants of {len(paths)} modules", flush=True)
    if options.anew:
        KILLED.unlink(missing_ok=True)
    campaign = Campaign(mutants, Covering(paths), options.seconds, options.workers, ends_s)
    run(campaign, [ROOT / test for test in options.tests])
    return report(mutants, campaign.judgements, time.monotonic() - ends_s + 60 * options.minutes)


def mutants_in(subjects: Sequence[str]) -> list[Mutant]:
    """Return all changes of modules (globs) and functions; end the program where a subject names nothing."""
    found: dict[Mutant, None] = {}
    for subject in subjects:
        glob, _, function = subject.partition("::")
        paths = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob(glob))
        mutants = [mutant for path in paths for mutant in mutants_of(path, ROOT)]
        named = [mutant for mutant in mutants if f"{mutant.place}.".startswith(f"{function}." if function else "")]
        if not paths or (function and not named):
            sys.exit(f"{subject}: there is nothing of that name to change")
        found |= dict.fromkeys(named)
    return list(found)


def report(mutants: Sequence[Mutant], judgements: Sequence[Judgement], took_s: float) -> int:
    """Print the figures and what lives; return the exit status."""
    equivalents = {
        (known["path"], known["place"], known["kind"], known.get("nth", 1))
        for known in tomllib.loads(EQUIVALENTS.read_text(encoding="utf-8"))["equivalent"]
    }
    found = Counter(judgement.verdict for judgement in judgements)
    living, false_claims = [], []
    for judgement in sorted(judgements, key=lambda each: each.number):
        mutant = mutants[judgement.number]
        lives = judgement.verdict in (Verdict.SURVIVED, Verdict.UNCOVERED)
        is_argued = mutant.address in equivalents
        if lives and not is_argued:
            living.append(f"{judgement.verdict}: {mutant}")
        elif is_argued and not lives:
            false_claims.append(f"killed, though it is listed as equivalent: {mutant}")
    judged = {judgement.number for judgement in judgements}
    open_ones = [f"not judged: {mutant}" for number, mutant in enumerate(mutants) if number not in judged]
    killed = found[Verdict.KILLED] + found[Verdict.TIMED_OUT]
    share = killed / max(1, len(judgements))
    print("\n".join(["", *false_claims, *living, *open_ones]))
    print(", ".join(f"{verdict} {found[verdict]}" for verdict in Verdict))
    argued = len(judgements) - killed - len(living)
    print(f"{killed} of {len(judgements)} killed: {share:.1%}; {argued} argued to be equivalent, {len(living)} not; "
          f"{len(open_ones)} not judged; {took_s / 60:.0f} minutes")  # fmt: skip
    return 1 if living or false_claims or open_ones or share < REQUIRED else 0


if __name__ == "__main__":
    sys.exit(main())
