"""Test each client of docs/libraries.md in a separate environment, installed as on the page.

    python tests/clients/run.py                # all of them
    python tests/clients/run.py torchrl minari

The packages of the line `pip install ...` in a section of the page are installed into
.venv-clients/NAME, with the versions of constraints-clients.txt. Then the client's tests run, and
the programs of the page. An environment is reused until the line, the constraints or pyproject.toml
change.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "libraries.md"
CONSTRAINTS = ROOT / "constraints-clients.txt"
SCRIPTS = "Scripts" if os.name == "nt" else "bin"  #: folder of a virtual environment's commands
SECTION = re.compile(r"^## (.+?)\n(.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL)
INSTALL = re.compile(r"^pip install (.+)$", re.MULTILINE)
PROGRAMS = "tests/contract/test_documentation.py::test_programs_run[libraries.md]"


def clients():
    """Return the packages that the page installs, by section name in lower case."""
    sections = SECTION.findall(PAGE.read_text(encoding="utf-8"))
    found = {name.lower(): INSTALL.search(text) for name, text in sections}
    return {name: shlex.split(line[1], comments=True) for name, line in found.items() if line}


def installed(name, packages):
    """Return the Python of a client's environment; make it if it is missing or out of date."""
    folder = ROOT / ".venv-clients" / name
    python, stamp = folder / SCRIPTS / "python", folder / "installed.txt"
    files = (CONSTRAINTS, ROOT / "pyproject.toml")
    wanted = "\n".join([*packages, *(file.read_text(encoding="utf-8") for file in files)])
    if not stamp.exists() or stamp.read_text(encoding="utf-8") != wanted:
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
        pip = [python, "-m", "pip", "install", "--quiet", "--no-compile", "-c", CONSTRAINTS]
        subprocess.run([*pip, *packages, "pytest", "hypothesis"], cwd=ROOT, check=True)
        stamp.write_text(wanted, encoding="utf-8")
    return python


def passes(name, packages):
    """Return True if a client can be installed and passes its tests."""
    print(f"==== {name}: pip install {shlex.join(packages)}", flush=True)
    try:
        python = installed(name, packages)
        for tests in (f"tests/clients/test_{name.replace('-', '_')}.py", PROGRAMS):
            # if the client cannot be imported, pytest collects no test and fails
            subprocess.run([python, "-m", "pytest", "-q", tests], cwd=ROOT, check=True)
    except subprocess.CalledProcessError as error:
        print(f"==== {name} failed: {error}", flush=True)
        return False
    return True


def main(names):
    """Test some clients, or all; return the exit code."""
    known = clients()
    if unknown := set(names) - set(known):
        print(f"clients must be of {', '.join(known)}, got {', '.join(unknown)}", file=sys.stderr)
        return 2
    failed = [name for name in names or known if not passes(name, known[name])]
    print(f"==== failed: {', '.join(failed)}" if failed else "==== all clients passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
