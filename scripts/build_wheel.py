"""Build hook of wheels: `make wheel` includes compiled kernels; other wheels need Numba."""

import os
import runpy
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

LOWEST_GLIBC = "2_17"
"""Lowest version of glibc that the libraries run with; `make wheel` verifies it."""


class KernelsHook(BuildHookInterface[Any]):
    """Wheels with the libraries for one family of processors, or with Numba as a dependency."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Set files, tag and dependencies of a wheel.

        Raises:
            RuntimeError: If a library belongs to other sources, or there is none.
        """
        family = os.environ.get("QUAD_GYM_WHEEL")
        if version == "editable" or not family:
            compiling = self.metadata.core.optional_dependencies["compile"]
            build_data["dependencies"] += compiling
            return
        package = Path(self.root, "quad_gym")
        functions = runpy.run_path(str(package / "kernels" / "sources.py"))
        libraries = sorted((package / "kernels" / "libraries").glob(f"kernels_{family}_*.so"))
        digest = functions["sources_digest"](package)
        stale = [f.name for f in libraries if functions["digest_in"](f.read_bytes()) != digest]
        if stale or not libraries:
            raise RuntimeError(
                f"quad-gym compile --library must come before: {', '.join(stale) or 'no library'}"
                f"{' belongs to other sources' if stale else ''}"
            )
        build_data["force_include"] |= {
            str(file): f"quad_gym/kernels/libraries/{file.name}" for file in libraries
        }
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-manylinux_{LOWEST_GLIBC}_{family}"
