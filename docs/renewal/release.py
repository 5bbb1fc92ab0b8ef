"""Facts of a release: `[tool.quad_gym.release]` in pyproject.toml, and the files that show them.

    python -m docs.renewal.release   # after an edit there, or of the version: write the files

Empty facts are not known yet: pages then describe a clone.
"""

import re
import sys
import tomllib
from pathlib import Path

import quad_gym
from docs.renewal import pages

ROOT = pages.ROOT
NAMES = {"date", "repository", "index", "site", "doi"}
_EXTRAS = "plot,render,train"


def facts() -> dict[str, str]:
    """The facts of the release by name, empty ones included, and its version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    found = project["tool"]["quad_gym"]["release"]
    if set(found) != NAMES or not all(isinstance(text, str) for text in found.values()):
        raise ValueError(f"[tool.quad_gym.release] must have the texts {', '.join(sorted(NAMES))}")
    return {"version": quad_gym.__version__, **found}


def texts(given: dict[str, str]) -> dict[str, str]:
    """Texts of pages, by the names of their marks."""
    wheel = f"quad_gym-{given['version']}-py3-none-manylinux_2_17_x86_64.whl"
    address = f"git+{given['repository'] or 'ADDRESS'}"
    clone = (
        f"To use it in a project, install it from a clone or, with `{address}` instead of the dot, "
        "from the repository\n([other machines](docs/start.md#install)):\n\n"
        f'```sh\npip install ".[compile,{_EXTRAS}]"'
    )
    index = (
        f'To use it in a project, install it:\n\n```sh\npip install "{given["index"]}[{_EXTRAS}]"'
    )
    return {
        "release.install": f"\n{index if given['index'] else clone}\n```\n",
        "release.wheel": f'`pip install -c constraints.txt "{wheel}[train,plot]"`',
        "release.site": f"The [site]({given['site']}) has"
        if given["site"]
        else "`make docs` builds the site with",
        "release.doi": f" and [doi:{given['doi']}](https://doi.org/{given['doi']})"
        if given["doi"]
        else "",
    }


def files(given: dict[str, str]) -> dict[Path, str]:
    """Texts of the files that are not pages."""
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    lines = [f"version: {given['version']}"]
    for key, name in (("date-released", "date"), ("doi", "doi"), ("url", "site")):
        lines += [f'{key}: "{given[name]}"'] if given[name] else []
    lines += [f'repository-code: "{given["repository"]}"'] if given["repository"] else []
    facts = r"^version: .*\n(?:(?:date-released|doi|url|repository-code): .*\n)*"
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    heading = f"## {given['version']} ({given['date'] or 'not yet released'})"
    return {
        ROOT / "CITATION.cff": re.sub(facts, "\n".join(lines) + "\n", citation, flags=re.M),
        ROOT / "CHANGELOG.md": re.sub(r"^## .*$", heading, changes, count=1, flags=re.M),
    }


def main() -> int:
    """Write all files and pages."""
    given = facts()
    for file, text in files(given).items():
        file.write_text(text, encoding="utf-8")
    changed = pages.write(texts(given))
    print(f"Wrote CITATION.cff, CHANGELOG.md {' '.join(page.name for page in changed)}".strip())
    return 0


if __name__ == "__main__":
    sys.exit(main())
