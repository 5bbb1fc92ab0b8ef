"""The one place that knows of threads: shares a range of blocks among the cores.

Kernels release the GIL, so plain threads run them side by side. A pool belongs to the process that
made it: after a fork the child makes its own, and a batch that is pickled or copied takes none
along.
"""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from quad_gym import validation as check
from quad_gym.kernels.compiling.cores import available_cores

MIN_BLOCKS_PER_THREAD = 4
"""Fewer blocks than this are not worth a hand-over to another thread (some 20 us)."""

MAX_THREADS = 1024
"""More than this is a mistake: each thread has memory of its own."""

_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}


def resolve_threads(threads: int | None) -> int:
    """`threads` checked, or the available cores where it is None.

    Raises:
        ValueError: If `threads` is not a whole number from 1 to MAX_THREADS.
    """
    if threads is None:
        return available_cores()
    return check.whole("threads", threads, most=MAX_THREADS)


def _pool(workers: int) -> ThreadPoolExecutor:
    key = (os.getpid(), workers)
    if key not in _pools:
        _pools[key] = ThreadPoolExecutor(workers, thread_name_prefix="quad_gym")
    return _pools[key]


def run_ranges(work: Callable[[int, int, int], None], blocks: int, threads: int) -> None:
    """Call `work(part, first, last)` on ranges that together cover `blocks` blocks.

    The first part runs in the calling thread. What the parts compute does not depend on how they
    are cut.

    Args:
        work: Called once per part, with the part's number and its range of blocks without the end.
        blocks: How many blocks there are.
        threads: The most parts to cut.
    """
    parts = max(1, min(threads, blocks // MIN_BLOCKS_PER_THREAD))
    if parts == 1:
        work(0, 0, blocks)
        return
    cuts = [blocks * part // parts for part in range(parts + 1)]
    pool = _pool(threads - 1)
    others: list[Future[None]] = [
        pool.submit(work, part, cuts[part], cuts[part + 1]) for part in range(1, parts)
    ]
    try:
        work(0, cuts[0], cuts[1])
    finally:
        for other in others:
            other.result()
