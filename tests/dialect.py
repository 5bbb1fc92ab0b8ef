"""Counter of words that a native engineer would not write, per 1,000 words of pages and docstrings.

    python -m tests.dialect              # the counts, as `make lint` prints them
    python -m tests.dialect --list NAME  # every find in pages and modules whose path contains NAME
    python -m tests.dialect --lower      # store lower numbers of finds as ceilings

A page, or the docstrings of one page of the interface, may have `LIMIT` finds per 1,000 words.
`dialect.json` holds the texts that still have more, with a ceiling that may only fall. The list of
words is the table in CONTRIBUTING.md.
"""

import argparse
import ast
import importlib
import inspect
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
CEILINGS = Path(__file__).with_suffix(".json")
LIMIT = 2.0


class Word(NamedTuple):
    """A word to avoid, its standard replacement, and the pattern that finds it."""

    word: str
    instead: str
    pattern: str


WORDS = (
    Word("doubt", "uncertainty, standard deviation, inflation", r"doubt(s|ed|ing|ful)?"),
    Word("told, tells", "observes, receives, distinguishes, reports", r"tells?|told"),
    Word(
        "sure, unsure", "certain, uncertain, confident", r"(?<!make )(?<!makes )(un)?sur(e|er|est)"
    ),
    Word("believes", "assumes", r"believ(e|es|ed|ing)|beliefs?"),
    Word(
        "a filter knows, thinks, wants, sees, finds, notices, trusts",
        "models, assumes, uses, receives, detects",
        r"(filter|estimator|ukf|ekf)s? (knows?|knew|thinks?|wants?|sees?|finds?|notices?|trusts?"
        r"|says?|is lost|are lost|gets? lost|stays? lost|is surprised|is right|are right)",
    ),
    Word("lies about, misled", "miscalibrated", r"l(ies|ied|ying) about|misled"),
    Word("ships, shipped", "included, pretrained, built-in", r"ships|shipped|shipping"),
    Word("wanted", "desired, requested", r"wanted"),
    Word("anew", "again, newly", r"anew"),
    Word("likewise", "a full phrase, with the unit", r"likewise"),
    Word("alike", "both, in the same way", r"alike"),
    Word("beside", "next to, in addition to, together with", r"beside"),
    Word("nobody, whoever", "no user, users who", r"nobody|whoever|whomever"),
    Word("of the same", "with the same, of this", r"of the same"),
    Word("that of, those of", "the noun again", r"(that|those) of"),
    Word("that there are", "available, defined, existing", r"that there (is|are|was|were)"),
    Word(
        "takes X for Y",
        "interprets as, attributes to",
        r"t(ake|akes|ook|aken|aking) (it|them|this|any \w+|an? \w+|the \w+)( that is \w+)? for"
        r"(?! (granted|example|each|every))",
    ),
    Word("what (outside questions)", "a noun", r"what(?! (to|if))"),
    Word(
        "says when, how, whether",
        "determines, explains",
        r"sa(y|ys|id) (when|how|whether|if|of|nothing)",
    ),
    Word(
        "paid, pays, fined",
        "rewarded, penalized, is worthwhile",
        r"paid|pays|payments?|fined|fines",
    ),
    Word("right again, is right", "consistent, correct", r"right again|(is|are|was|were|be) right"),
    Word(
        "deviation, alone",
        "standard deviation",
        r"(?<!standard )(?<!standard-)deviations?(?! (from|between|to))",
    ),
    Word("errs", "is wrong, is off by, has an error", r"errs?|erred|erring"),
    Word("less the", "minus the", r"less (the|its|their)"),
    Word("of its own", "its own, separate", r"of (its|their|one's) own"),
    Word("in silence", "undetected", r"in silence"),
    Word("withheld", "masked, hidden", r"with(hold|holds|held|holding)"),
    Word("nothing but", "only", r"nothing but"),
    Word("to the bit, to the letter", "bitwise, exactly", r"to the (bit|letter|full)"),
    Word(
        "seldom, thereof, upon",
        "rarely, of it, on",
        r"seldom|there(of|in|upon)|where(of|in|upon|by)|hence(forth)?|upon|thence|whence|hitherto",
    ),
    Word("mends, judges", "repairs, evaluates", r"mend(s|ed|ing)?|judg(e|es|ed|ing)"),
    Word("stands in, below", "is in, is below", r"st(ands?|ood) (in|below|above|there|here)"),
    Word(
        "towards, colour, metre",
        "American spelling",
        r"towards|whilst|amongst|colour\w*|behaviour\w*|neighbour\w*|metres?|centres?|grey"
        r"|(normal|minim|maxim|optim|initial|random|linear|discret|general|visual)is\w+",
    ),
)
"""The words of the table in CONTRIBUTING.md."""

OPENINGS = (
    r"(What|Whether|Which|Who|Whose|How|Where|Of|Likewise|Its|Their|The same|Same|In place of)\b"
)
"""Openings of docstrings besides "What"; a docstring begins with a noun or an imperative verb."""

PATTERN = re.compile("|".join(rf"\b(?:{word.pattern})\b" for word in WORDS), re.IGNORECASE)
QUOTED = re.compile(
    r"^(?P<fence>[ ]*```+).*?^(?P=fence)[ ]*$|\$\$.*?\$\$|``[^`]+``|`[^`\n]+`|\$[^$\n]+\$"
    r"|<!--.*?-->|\]\([^)]*\)|https?://\S+",
    re.MULTILINE | re.DOTALL,
)
TABLE_OF_WORDS = re.compile(r"<!-- words -->.*?<!-- /words -->", re.DOTALL)
QUESTION = re.compile(r"[^.:;|]*\?")


@dataclass(frozen=True)
class Count:
    """Words of a text, and what is found in it: (line, excerpt)."""

    words: int
    found: tuple[tuple[int, str], ...]

    @property
    def rate(self) -> float:
        """Finds per 1,000 words."""
        return 1000 * len(self.found) / max(self.words, 1)

    def __add__(self, other: "Count") -> "Count":
        return Count(self.words + other.words, self.found + other.found)


NONE = Count(0, ())


def blanked(found: re.Match[str]) -> str:
    """As many characters and lines, but one word."""
    return "X" + re.sub(r"[^\n]", " ", found[0][1:])


def is_numbers(line: str) -> bool:
    """True for a row of a table with more numbers than words."""
    cells = [cell for cell in line.strip().strip("|").split("|") if cell.strip()]
    return line.lstrip().startswith("|") and 2 * sum(c.isdigit() for c in "".join(cells)) > sum(
        c.isalpha() for c in "".join(cells)
    )


def count(text: str, first_line: int = 1) -> Count:
    """Words and finds in prose with Markdown, without its code, formulas, links and numbers."""
    text = QUOTED.sub(blanked, TABLE_OF_WORDS.sub(blanked, text))
    text = "\n".join("" if is_numbers(line) else line for line in text.split("\n"))
    found = []
    for match in PATTERN.finditer(re.sub(r"\n(?!\n)", " ", text)):
        asked = QUESTION.match(text, match.start())
        if match[0].lower() == "what" and asked:
            continue
        excerpt = " ".join(text[max(match.start() - 40, 0) : match.end() + 30].split())
        line = first_line + text.count("\n", 0, match.start())
        found.append((line, f"[{match[0]}] {excerpt}"))
    return Count(len(re.findall(r"[A-Za-z][A-Za-z'-]+", text)), tuple(found))


def count_docstring(text: str, first_line: int) -> Count:
    """As `count`, with the opening."""
    text = inspect.cleandoc(text)
    opening = re.match(OPENINGS, text)
    finds = ((first_line, f"[{opening[0]} ...] {' '.join(text.split())[:60]}"),) if opening else ()
    return count(text, first_line) + Count(0, finds)


def docstrings(file: Path) -> Iterator[tuple[str, str, int]]:
    """(qualified name, text, line) of the docstrings of a module, its attributes' included."""

    def visit(node: ast.AST, name: str) -> Iterator[tuple[str, str, int]]:
        body = getattr(node, "body", [])
        owner = name
        for k, part in enumerate(body):
            if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant):
                if isinstance(part.value.value, str) and (k == 0 or owner != name):
                    yield owner, part.value.value, part.lineno
                owner = name
            elif isinstance(part, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
                yield from visit(part, f"{name}.{part.name}".lstrip("."))
                owner = name
            elif isinstance(part, ast.Assign | ast.AnnAssign):
                target = part.targets[0] if isinstance(part, ast.Assign) else part.target
                owner = f"{name}.{ast.unparse(target)}".lstrip(".")
            else:
                owner = name

    yield from visit(ast.parse(file.read_text(encoding="utf-8")), "")


def interface() -> dict[str, list[tuple[Path, str]]]:
    """(file, qualified name) of the objects on each page of the interface; "": a module."""
    objects: dict[str, list[tuple[Path, str]]] = {}
    for page in sorted((ROOT / "docs" / "api").glob("*.md")):
        listed = objects.setdefault(page.stem, [])
        text = page.read_text(encoding="utf-8")
        for kind, name in re.findall(
            r"auto(module|class|function|data|exception):: ([\w.]+)", text
        ):
            if kind == "module":
                module = importlib.import_module(name)
                members = getattr(module, "__all__", ()) or [
                    key
                    for key, value in vars(module).items()
                    if getattr(value, "__module__", None) == name and not key.startswith("_")
                ]
                values = [getattr(module, key) for key in members]
                listed.append((Path(str(module.__file__)), ""))
            else:
                module_name, _, attribute = name.rpartition(".")
                values = [getattr(importlib.import_module(module_name), attribute)]
            for value in values:
                if hasattr(value, "__qualname__") and value.__module__.startswith(
                    ("quad_gym", "baselines")
                ):
                    source = Path(str(sys.modules[value.__module__].__file__))
                    listed.append((source, value.__qualname__))
    return objects


def is_private(name: str) -> bool:
    """True for inner names; methods such as `__call__` have no page either."""
    return any(part.startswith("_") for part in name.split("."))


def counts() -> dict[str, Count]:
    """The count of every page, of the public docstrings by page of the interface, and of others."""
    found = {}
    pages = [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "docs" / "api").glob("*.md"),
    ]
    for page in sorted(pages):
        found[page.relative_to(ROOT).as_posix()] = count(page.read_text(encoding="utf-8"))
    for file in sorted((ROOT / "docs" / "gallery").glob("*.py")):
        text = file.read_text(encoding="utf-8")
        head = ast.get_docstring(ast.parse(text)) or ""
        prose = "\n".join(line[2:] if line.startswith("# ") else "" for line in text.split("\n"))
        found[file.relative_to(ROOT).as_posix()] = count(head) + count(prose)
    public: set[tuple[Path, str, int]] = set()
    texts = {
        file: list(docstrings(file))
        for folder in ("quad_gym", "baselines")
        for file in sorted((ROOT / folder).rglob("*.py"))
    }
    for section, objects in interface().items():
        total = NONE
        for file, listed in objects:
            for name, text, line in texts.get(file, ()):
                inside = name == listed or (listed and name.startswith(f"{listed}."))
                if inside and not is_private(name) and (file, name, line) not in public:
                    public.add((file, name, line))
                    total += located(count_docstring(text, line), file)
        found[f"docstrings of docs/api/{section}.md"] = total
    for file, parts in texts.items():
        top, *rest = file.relative_to(ROOT).parts
        group = (
            f"inner docstrings of {top}/{rest[0]}"
            if len(rest) > 1
            else f"inner docstrings of {top}"
        )
        if "commands" in rest:
            group = "docstrings of quad_gym/commands"
        for name, text, line in parts:
            if (file, name, line) not in public:
                found[group] = found.get(group, NONE) + located(count_docstring(text, line), file)
    return found


def located(part: Count, file: Path) -> Count:
    """The count with the file before each find."""
    where = file.relative_to(ROOT).as_posix()
    return Count(part.words, tuple((line, f"{where}:{line} {text}") for line, text in part.found))


def ceilings() -> dict[str, int]:
    """The highest number of finds of each text that is above the limit, by name."""
    stored: dict[str, int] = json.loads(CEILINGS.read_text(encoding="utf-8"))
    return stored


def too_many(found: dict[str, Count]) -> list[str]:
    """Names of the texts above the limit, with more finds than their ceilings."""
    highest = ceilings()
    return [n for n, c in found.items() if c.rate > LIMIT and len(c.found) > highest.get(n, 0)]


def table() -> str:
    """The rows of the table in CONTRIBUTING.md."""
    rows = ["| avoid | write |", "|---|---|", *(f"| {w.word} | {w.instead} |" for w in WORDS)]
    return "\n".join(rows)


def lower(found: dict[str, Count]) -> None:
    """Store fewer finds as ceilings; drop texts below the limit, and those that are gone."""
    kept = {
        name: min(highest, len(found[name].found))
        for name, highest in sorted(ceilings().items())
        if name in found and found[name].rate > LIMIT
    }
    CEILINGS.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", metavar="NAME", help="print every find in texts with this name")
    parser.add_argument("--lower", action="store_true", help="store lower rates as ceilings")
    options = parser.parse_args()
    found = counts()
    if options.lower:
        lower(found)
    for name, c in found.items():
        if options.list is None and c.found:
            print(f"{c.rate:6.1f} per 1,000, {len(c.found):4d} in {c.words:6,d} words: {name}")
        for line, text in c.found if options.list is not None else ():
            where = f"{name}:{line} {text}" if "docstrings" not in name else text
            if options.list in where:
                print(where)
    total = sum(found.values(), NONE)
    if options.list is None:
        print(f"{total.rate:6.1f} per 1,000, {len(total.found):4d} in {total.words:6,d} words: all")
    bad = too_many(found)
    for name in bad:
        print(
            f"{name}: {len(found[name].found)} words of the table in CONTRIBUTING.md, "
            f"at most {ceilings().get(name, 0)} are allowed; python -m tests.dialect --list ...",
            file=sys.stderr,
        )
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
