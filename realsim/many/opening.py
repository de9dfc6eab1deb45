"""A pool, opened as it was asked for."""

from collections.abc import Generator
from contextlib import contextmanager

from realsim.many.pool import Pool, PoolConfig, Workers
from realsim.many.processes import local_pool
from realsim.many.ray_pool import ray_pool


@contextmanager
def open_pool(where: Workers = None) -> Generator[Pool]:
    """Yield who does the work; leaving ends it, in the middle of jobs where an error leaves.

    Args:
        where: a number = so many processes, 1 = this one; None = one a core.

    Raises:
        InputError: the cluster is not there, lets in anyone, or Ray is not installed.
    """
    config = where if isinstance(where, PoolConfig) else PoolConfig(workers=where)
    if config.address:
        with ray_pool(config) as pool:
            yield pool
        return
    with local_pool(config.workers) as pool:
        yield pool
