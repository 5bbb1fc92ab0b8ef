"""The digest that ties a library of compiled kernels to its sources. Imports nothing else of ours.

The build of a wheel runs this file by itself.
"""

import hashlib
from pathlib import Path

MARK = b"quad_gym kernels "  #: beginning of the text with the digest in a library


def sources_digest(package: Path) -> str:
    """Return the digest of the sources that shape compiled code.

    Args:
        package: Folder of `quad_gym`.
    """
    digest = hashlib.sha256()
    for folder in ("kernels", "records", "params"):
        for file in sorted((package / folder).rglob("*.py")):
            content = file.read_bytes()
            name = file.relative_to(package).as_posix()
            digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def digest_in(library: bytes) -> str:
    """Return the digest in the content of a library; empty: there is none."""
    begin = library.find(MARK)
    return "" if begin < 0 else library[begin + len(MARK) :][:64].decode("ascii", "replace")
