"""Number of cores that this process may use."""

import os


def available_cores() -> int:
    """Number of cores that this process may use, by its affinity, quota and NUMBA_NUM_THREADS."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    quota = _cgroup_cores()
    if quota is not None:
        cores = min(cores, quota)
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    return max(1, min(cores, int(limit))) if limit.isdigit() and int(limit) > 0 else cores


def _cgroup_cores() -> int | None:
    """Number of whole cores that a container's quota allows, if there is one."""
    try:
        with open("/sys/fs/cgroup/cpu.max", encoding="ascii") as file:
            quota, period = file.read().split()
        return None if quota == "max" else max(1, int(quota) // int(period))
    except (OSError, ValueError):
        return None
