"""The processor."""

import platform
from pathlib import Path
from typing import Any

from quad_gym.kernels.cores import available_cores


def processor() -> dict[str, Any]:
    """Name and vector instructions of the processor, as far as the system reports them."""
    found: dict[str, Any] = {"machine": platform.machine(), "cores": available_cores()}
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return found | {"model": platform.processor()}
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        fields.setdefault(name.strip(), value.strip())
    flags = fields.get("flags", fields.get("Features", "")).split()
    vector = [flag for flag in flags if flag.startswith(("avx", "fma", "sse4", "asimd", "sve"))]
    return found | {"model": fields.get("model name", ""), "vector_instructions": vector}
