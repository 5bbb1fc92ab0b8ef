"""Build hooks: the metadata of wheel and sdist, and the compiled kernels that wheels may hold.

QUAD_GYM_WHEEL: family of processors whose libraries the wheel holds, as `make wheel` sets it; it
then does not depend on Numba. QUAD_GYM_URL: address of the repository, in place of
the one in pyproject.toml.
"""

import os
import re
import runpy
import tomllib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

LOWEST_GLIBC = "2_17"
"""Lowest version of glibc that the libraries run with; `make wheel` verifies it."""
FAMILY = "QUAD_GYM_WHEEL"


class MetadataHook(MetadataHookInterface):
    """Dependencies, addresses and README, which every installer reads before a wheel is built."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the dynamic fields."""
        compiling = metadata["optional-dependencies"]["compile"]
        needed = [] if os.environ.get(FAMILY) else compiling
        metadata["dependencies"] = [*self.config["dependencies"], *needed]
        project = tomllib.loads(Path(self.root, "pyproject.toml").read_text(encoding="utf-8"))
        repository = project["tool"]["quad_gym"]["release"]["repository"]
        url = (os.environ.get("QUAD_GYM_URL") or repository).rstrip("/")
        tag = f"v{metadata['version']}"
        pages = {"Issues": "issues", "Changelog": f"blob/{tag}/CHANGELOG.md"}
        pages["Documentation"] = f"tree/{tag}/docs"
        named = {name: f"{url}/{page}" for name, page in pages.items()}
        metadata["urls"] = {"Source": url, **named} if url else {}
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        if url:
            text = text.replace("](../../", f"]({url}/")  # README lies in url/blob/BRANCH
            text = absolute_links(text, f"{url}/blob/{tag}/", f"{url}/raw/{tag}/")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute_links(text: str, pages: str, pictures: str) -> str:
    """Return Markdown with addresses in place of relative links to pages and pictures."""
    text = re.sub(r"(!\[[^\]]*\]\()(?!\w+:)", rf"\g<1>{pictures}", text)
    return re.sub(r"(\]\()(?!\w+:|#)", rf"\g<1>{pages}", text)


class KernelsHook(BuildHookInterface[Any]):
    """Wheels with the libraries for one family of processors, and the modules for GPUs."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Set files and tag of a wheel.

        Raises:
            RuntimeError: If a library belongs to other sources, or there is none.
        """
        family = os.environ.get(FAMILY)
        if version == "editable" or not family:
            return
        package = Path(self.root, "quad_gym")
        functions = runpy.run_path(str(package / "kernels" / "sources.py"))
        folder = package / "kernels" / "libraries"
        libraries = sorted(folder.glob(f"kernels_linux_{family}_*.so"))
        modules = sorted(folder.glob("*.ptx.z"))  # for GPUs
        digest = functions["sources_digest"](package)
        stale = [f.name for f in libraries if functions["digest_in"](f.read_bytes()) != digest]
        stale += [f.name for f in modules if not f.name.startswith(digest[:12])]
        if stale or not libraries:
            raise RuntimeError(
                "quad-gym compile --library, and --ptx if there are modules for GPUs, must come "
                f"before: {', '.join(stale) or 'no library'}"
                f"{' belongs to other sources' if stale else ''}"
            )
        build_data["force_include"] |= {
            str(file): f"quad_gym/kernels/libraries/{file.name}" for file in (*libraries, *modules)
        }
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-manylinux_{LOWEST_GLIBC}_{family}"
