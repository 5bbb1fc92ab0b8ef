"""Run EstimateBench, print its table, and fly and check entries.

    python -m scripts.estimate_bench run               # the baselines; continues where it stopped
    python -m scripts.estimate_bench table             # from docs/data/estimate_bench.csv
    python -m scripts.estimate_bench fly ENTRY         # fly an entry, and write its results into it
    python -m scripts.estimate_bench check ENTRY ...   # fly entries, compare digit by digit

`check` without a name checks all entries. docs/benchmark.md is the protocol.
"""

import argparse
import sys
from pathlib import Path

from quad_gym.commands.options import quiet_end
from scripts.estimate_bench import entries
from scripts.estimate_bench.table import ENTRIES, texts
from scripts.studies.campaign import EPISODES, FIRST_EPISODE


def check(folders: list[Path]) -> int:
    """Fly entries and compare; returns the exit code, 1 if one differs."""
    code = 0
    for folder in folders:
        try:
            entry = entries.Entry.read(folder)
            different = entry.differences()
        except entries.EntryError as error:
            different = [str(error)]
        for line in different:
            print(f"{folder.name}: {line}")
        if different:
            code = 1
        else:
            count = len(entry.policies)
            print(f"{folder.name}: equal in every digit, {count} policies")
    if not folders:
        print(f"{ENTRIES} has no entries yet.")
    return code


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m scripts.estimate_bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="measure the baselines, and continue where it stopped")
    run.add_argument("--jobs", type=int, default=1, help="number of processes")
    run.add_argument("--list", action="store_true", help="print what is left, and stop")
    commands.add_parser("table", help="print the table")
    flying = commands.add_parser("fly", help="fly an entry, and write its results")
    flying.add_argument("entry", type=Path)
    flying.add_argument("--episodes", type=int, default=EPISODES)
    flying.add_argument("--first-episode", type=int, default=FIRST_EPISODE)
    checking = commands.add_parser("check", help="fly entries, and compare digit by digit")
    checking.add_argument("entry", type=Path, nargs="*", help="folders; none: all entries")
    args = parser.parse_args(argv)
    if args.command == "run":
        from scripts.studies import run as campaign

        tables = ("estimate_bench",)
        return campaign.main(campaign.RunArgs(tables=tables, jobs=args.jobs, list=args.list))
    if args.command == "table":
        print(texts()["benchmark.table"])
        return 0
    if args.command == "fly":
        try:
            entries.fly(args.entry, args.episodes, args.first_episode)
        except entries.EntryError as error:
            parser.error(str(error))
        return check([args.entry])
    every = sorted(file.parent for file in ENTRIES.glob(f"*/{entries.FILE}"))
    return check(args.entry or every)


if __name__ == "__main__":
    with quiet_end():
        sys.exit(main())
