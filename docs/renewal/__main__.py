"""Renew the numbers, tables and figures of README and the pages that are out of date.

    python -m docs.renewal            # measure all stale results, and write the pages
    python -m docs.renewal --list     # list them, with their last durations
    python -m docs.renewal --only circle compare
    python -m docs.renewal --only speed_suites --again   # even if it is up to date

Studies and the benchmark are measured by `python -m scripts.studies run --all`, in many core hours,
and their rows in docs/data are written into the pages here.

Commands write into results/renewal/NAME. Studies, comparisons, sweeps and large tables resume where
an interrupted run stopped.
"""

import argparse
import shutil
import subprocess
import sys
import time
from pathlib import Path

from docs.renewal import ledger, pages
from docs.renewal.catalog import CATALOG, Result
from scripts.studies.conclusions import incomplete
from scripts.studies.run import PARTS

OUTPUT = Path("results/renewal")


def measure(result: Result) -> dict[str, object]:
    """Run the commands of a result, and copy its figures.

    Returns:
        Entry of the result in the ledger.
    """
    folder, printed = OUTPUT / result.name, []
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    for number, command in enumerate(result.commands):
        words = [word.replace("OUT", str(folder / str(number))) for word in command.split()]
        module = words[0].startswith(("scripts.", "docs."))
        program = ["-m"] if module else [] if words[0].endswith(".py") else ["-m", "quad_gym"]
        print(f"  {' '.join(words)}", flush=True)
        done = subprocess.run(
            [sys.executable, *program, *words], stdout=subprocess.PIPE, text=True, check=True
        )
        (folder / f"{number}.txt").write_text(done.stdout, encoding="utf-8")
        printed.append(done.stdout)
    texts = result.texts(folder, printed)
    for source, target in result.figures.items():
        (pages.ROOT / target).parent.mkdir(exist_ok=True)
        shutil.copyfile(folder / source, pages.ROOT / target)
    return {
        "commands": result.commands,
        "flights": ledger.digest(result),
        "minutes": round((time.monotonic() - began) / 60.0, 1),
        "texts": texts,
    }


def main() -> int:
    """Measure stale results one after the other, and write their texts into the pages."""
    parser = argparse.ArgumentParser(prog="make results", description=__doc__.split("\n")[0])
    parser.add_argument("--list", action="store_true", help="say what is stale, and stop")
    parser.add_argument("--only", nargs="+", choices=sorted(CATALOG), help="names of results")
    parser.add_argument("--again", action="store_true", help="measure what is up to date, too")
    args = parser.parse_args()
    entries = {name: entry for name, entry in ledger.read().items() if name in CATALOG}
    chosen = [CATALOG[name] for name in args.only or CATALOG]
    due = [result for result in chosen if args.again or ledger.stale(result, entries)]
    for result in due:
        minutes = entries.get(result.name, {}).get("minutes")
        last = "" if minutes is None else f", {minutes:g} min last time"
        print(f"{result.name}: {'again' if args.again else 'stale'}{last}")
    for part in incomplete(PARTS) if args.only is None else ():
        print(f"{part.table}: stale, {part.decides} (python -m scripts.studies run --all)")
    if args.list:
        return 0
    for result in due:
        print(f"{result.name} ...", flush=True)
        if args.again:
            shutil.rmtree(OUTPUT / result.name, ignore_errors=True)
        entries[result.name] = measure(result)
        ledger.write(entries)
    changed = pages.write(ledger.texts(entries))
    print(f"{len(chosen) - len(due)} results were up to date, {len(due)} are new.")
    print(f"Wrote {', '.join(page.name for page in changed)}." if changed else "No page changed.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
