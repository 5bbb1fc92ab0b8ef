"""The digest that ties a library of compiled kernels to its sources. Imports nothing else of ours.

The build of a wheel runs this file by itself.
"""

import hashlib
import re
from pathlib import Path

MARK = b"quad_gym kernels "  #: beginning of the text with the digest in a library


def sources_digest(package: Path) -> str:
    """Return the digest of the sources that shape compiled code.

    Args:
        package: Folder of `quad_gym`.
    """
    digest = hashlib.sha256()
    files = [file for folder in ("kernels", "records") for file in (package / folder).rglob("*.py")]
    table = package / "params" / "sensor_table.py"  # of sensors, from whose classes records follow
    if table.is_file():
        names = re.findall(r"^from quad_gym\.params\.(\w+) import", table.read_text(), re.MULTILINE)
        files += [table, *(table.with_name(f"{name}.py") for name in names)]
    for file in sorted(files):
        content = file.read_bytes()
        name = file.relative_to(package).as_posix()
        digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def digest_in(library: bytes) -> str:
    """Return the digest in the content of a library; empty: there is none."""
    begin = library.find(MARK)
    return "" if begin < 0 else library[begin + len(MARK) :][:64].decode("ascii", "replace")
