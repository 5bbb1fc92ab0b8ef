"""Counter of words that a native engineer would not write, in pages, docstrings and names of tests.

    python -m tests.dialect              # the counts per 1,000 words, as `make lint` prints them
    python -m tests.dialect --list NAME  # every find in pages and folders whose name contains NAME

A text is a page, or the docstrings and tables of a folder. It may have one find, or up to `LIMIT`
per 1,000 words. The table in CONTRIBUTING.md has the standard words to write instead.
"""

import argparse
import ast
import inspect
import re
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
LIMIT = 2.0

WORDS = {
    "doubt": r"doubt(s|ed|ing|ful)?",
    "told, tells": r"tells?|told",
    "sure, unsure": r"(?<!make )(?<!makes )(un)?sur(e|er|est)",
    "believes": r"believ(e|es|ed|ing)|beliefs?",
    "a filter knows, thinks, wants, sees, finds, notices, trusts": (
        r"(filter|estimator|ukf|ekf)s? (knows?|knew|thinks?|wants?|sees?|finds?|notices?|trusts?"
        r"|says?|is lost|are lost|gets? lost|stays? lost|is surprised|is right|are right)"
    ),
    "lies about, misled": r"l(ies|ied|ying) about|misled",
    "ships, shipped": r"ships|shipped|shipping",
    "wanted": r"wanted",
    "anew": r"anew",
    "likewise": r"likewise",
    "alike": r"alike",
    "beside": r"beside",
    "nobody, whoever": r"nobody|whoever|whomever",
    "of the same": r"of the same",
    "that of, those of": r"(that|those) of",
    "that there are": r"that there (is|are|was|were)",
    "takes X for Y": (
        r"t(ake|akes|ook|aken|aking) (it|them|this|any \w+|an? \w+"
        r"|the \w+)( that is \w+)? for(?! (granted|example|each|every))"
    ),
    "what (outside questions)": r"what(?! (to|if))",
    "says when, how, whether": r"sa(y|ys|id) (when|how|whether|if|of|nothing)",
    "paid, pays, fined": r"paid|pays|payments?|fined|fines",
    "right again, is right": r"right again|(is|are|was|were|be) right",
    "deviation, alone": r"(?<!standard )(?<!standard-)deviations?(?! (from|between|to))",
    "errs": r"errs?|erred|erring",
    "less the": r"less (the|its|their)",
    "of its own": r"of (its|their|one's) own",
    "in silence": r"in silence",
    "withheld": r"with(hold|holds|held|holding)",
    "nothing but": r"nothing but",
    "to the bit, to the letter": r"to the (bit|letter|full)",
    "seldom, thereof, upon": (
        r"seldom|there(of|in|upon)|where(of|in|upon|by)|hence(forth)?|upon|thence|whence"
        r"|hitherto"
    ),
    "mends, judges": r"mend(s|ed|ing)?|judg(e|es|ed|ing)",
    "stands in, below": r"st(ands?|ood) (in|below|above|there|here)",
    "towards, colour, metre": (
        r"towards|whilst|amongst|colour\w*|behaviour\w*|neighbour\w*|metres?|centres?|grey"
        r"|(normal|minim|maxim|optim|initial|random|linear|discret|general|visual)is\w+"
    ),
}
"""Words to avoid, as in the table of CONTRIBUTING.md, and the patterns that find them."""

PATTERN = re.compile("|".join(rf"\b(?:{pattern})\b" for pattern in WORDS.values()), re.IGNORECASE)
OPENINGS = (
    r"(What|Whether|Which|Who|Whose|How|Where|Of|Likewise|Its|Their|The same|Same|In place of)\b"
)
"""Openings to avoid: a docstring begins with a noun or an imperative verb."""

ROWS = ("Field", "Quantity", "Drawable", "Column", "field", "record", "shown")
"""Calls that make the rows of tables, each with a description."""

SEMICOLONS = 6.0  #: largest number per 1,000 words of a page
VERBS = (
    r"(is|are|was|were|be|has|have|had|do|does|can|cannot|may|must|will|adds?|begin|belong|build|"
    r"builds|compiles?|consider|evaluates?|exports?|follows?|include|install|lets?|lists?|"
    r"localize|look|looks|makes?|need|needs|provides?|reach|read|report|see|selects?|shows?|"
    r"simulates?|succeeds?|takes?|use|uses)"
)
"""Verbs of sentences in README, one of which each sentence needs."""

TABLE_OF_WORDS = r"<!-- words -->.*?<!-- /words -->"
QUOTED = re.compile(
    TABLE_OF_WORDS + r"|^(?P<fence>[ ]*```+).*?^(?P=fence)[ ]*$|\$\$.*?\$\$|``[^`]+``|`[^`\n]+`"
    r"|\$[^$\n]+\$|<!--.*?-->|\]\([^)]*\)|https?://\S+",
    re.MULTILINE | re.DOTALL,
)
QUESTION = re.compile(r"[^.:;|]*\?")


class Count(NamedTuple):
    """Number of words of a text, and its finds, with their places."""

    words: int
    found: list[str]

    @property
    def rate(self) -> float:
        """Finds per 1,000 words."""
        return 1000 * len(self.found) / max(self.words, 1)


def blanked(found: re.Match[str]) -> str:
    """Return one word with as many characters and lines."""
    return "X" + re.sub(r"[^\n]", " ", found[0][1:])


def is_numbers(line: str) -> bool:
    """Return True for a row of a table with more than half as many digits as letters."""
    digits, letters = (sum(map(kind, line)) for kind in (str.isdigit, str.isalpha))
    return line.lstrip().startswith("|") and 2 * digits > letters


def count(text: str, where: str, first_line: int = 1) -> Count:
    """Words and finds in prose with Markdown, without its code, formulas, links and numbers."""
    text = QUOTED.sub(blanked, text)
    text = "\n".join("" if is_numbers(line) else line for line in text.split("\n"))
    found = []
    for match in PATTERN.finditer(re.sub(r"\n(?!\n)", " ", text)):
        if match[0].lower() == "what" and QUESTION.match(text, match.start()):
            continue
        excerpt = " ".join(text[max(match.start() - 40, 0) : match.end() + 30].split())
        line = first_line + text.count("\n", 0, match.start())
        found.append(f"{where}:{line} [{match[0]}] {excerpt}")
    return Count(len(re.findall(r"[A-Za-z][A-Za-z'-]+", text)), found)


def prose(page: Path) -> str:
    """Sentences of a page, without code, formulas, links, tables and headings."""
    text = QUOTED.sub(blanked, page.read_text(encoding="utf-8"))
    return "\n".join(line for line in text.split("\n") if not re.match(r"\s*(\||#|\[!)", line))


def syntax() -> list[str]:
    """Pages with too many semicolons, and sentences of README without a verb."""
    bad = []
    for file in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]):
        name, text = file.relative_to(ROOT).as_posix(), prose(file)
        words, found = len(re.findall(r"[A-Za-z][A-Za-z'-]+", text)), text.count(";")
        if found > max(1.0, SEMICOLONS * words / 1000.0):
            bad.append(f"{name} has {found} semicolons in {words} words")
    for sentence in re.split(r"(?<=[.:?])\s|\n\n|\n- ", prose(ROOT / "README.md")):
        if len(re.findall(r"[a-z]{2,}", sentence)) > 2 and not re.search(
            rf"\b{VERBS}\b", sentence, re.IGNORECASE
        ):
            bad.append(f"README.md has a sentence without a verb: {' '.join(sentence.split())}")
    return bad


def descriptions(tree: ast.AST) -> list[tuple[int, str]]:
    """Lines and descriptions of the rows of tables, such as `Field(...)`: the last text of each."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ROWS:
            values = [getattr(argument, "value", None) for argument in node.args]
            texts = [value for value in values if isinstance(value, str) and " " in value]
            found += [(node.lineno, text) for text in texts[-1:]]
    return found


def docstrings(file: Path) -> list[Count]:
    """Counts of docstrings, descriptions behind constants and in tables, and names of tests."""
    where, text = file.relative_to(ROOT).as_posix(), file.read_text(encoding="utf-8")
    behind = enumerate((line.partition("  #: ")[2] for line in text.split("\n")), start=1)
    counts = [count(words, where, line) for line, words in behind if words]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            counts.append(count(node.name.replace("_", " "), where, node.lineno))
        value = getattr(node.value, "value", None) if isinstance(node, ast.Expr) else None
        if isinstance(value, str):
            text = inspect.cleandoc(value)
            counts.append(count(text, where, node.lineno))
            counts += badly_opened(text, where, node.lineno)
    for line, words in descriptions(ast.parse(file.read_text(encoding="utf-8"))):
        counts.append(count(words, where, line))
        counts += badly_opened(words[:1].upper() + words[1:], where, line)
    return counts


def badly_opened(text: str, where: str, line: int) -> list[Count]:
    """Return one find if a text begins with one of OPENINGS."""
    opening = re.match(OPENINGS, text)
    return [Count(0, [f"{where}:{line} [{opening[0]} ...] {text[:60]}"])] if opening else []


def counts() -> dict[str, Count]:
    """Counts by name of the page or folder."""
    parts: dict[str, list[Count]] = {}
    for pattern in ("*.md", "docs/*.md", "docs/api/*.md"):
        for file in sorted(ROOT.glob(pattern)):
            page = file.relative_to(ROOT).as_posix()
            parts[page] = [count(file.read_text(encoding="utf-8"), page)]
    for file in sorted((ROOT / "docs" / "gallery").glob("*.py")):
        page, text = file.relative_to(ROOT).as_posix(), file.read_text(encoding="utf-8")
        prose = "\n".join(line[2:] if line.startswith("# ") else "" for line in text.split("\n"))
        head = ast.get_docstring(ast.parse(text)) or ""
        parts[page] = [count(head, page), count(prose, page)]
    for folder in ("quad_gym", "baselines", "docs", "scripts", "tests"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            name = "/".join(file.relative_to(ROOT).parts[:-1][:2])
            parts.setdefault(f"docstrings of {name}", []).extend(docstrings(file))
    return {
        name: Count(sum(c.words for c in each), [find for c in each for find in c.found])
        for name, each in parts.items()
    }


def too_many(found: dict[str, Count]) -> list[str]:
    """Names of the texts above the limit."""
    return [name for name, c in found.items() if len(c.found) > 1 and c.rate > LIMIT]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", metavar="NAME", help="print every find in texts with this name")
    name, found = parser.parse_args().list, counts()
    for text, c in found.items():
        if name is None and c.found:
            print(f"{c.rate:6.1f} per 1,000, {len(c.found):4d} in {c.words:6,d} words: {text}")
        elif name is not None and name in text:
            print(*c.found, sep="\n")
    bad = too_many(found)
    for text in bad:
        print(f"{text} has too many words of the table in CONTRIBUTING.md", file=sys.stderr)
    print(*(wrong := syntax()), sep="\n", file=sys.stderr)
    return int(bool(bad or wrong))


if __name__ == "__main__":
    raise SystemExit(main())
