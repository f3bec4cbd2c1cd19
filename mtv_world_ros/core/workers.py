"""Workers of a command that runs many jobs: processes of this machine or of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from mtv_world_ros.core.processes import threads_each

Job = TypeVar('Job')
#: runs jobs, and yields each with its result when it is done
RunJobs = Callable[[Sequence[Job]], Iterator[tuple[Job, Any]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Workers:
    """Workers of a command: processes of this machine, or actors of a Ray cluster.

    Attributes:
        count: number of workers, i.e. of jobs that run at once; 1 without Ray = this process.
        threads: CPU threads of each worker; 0 = with Ray `cpus`, else the cores shared evenly.
        ray: address of a Ray cluster; empty = `RAY_ADDRESS`, else a new one on this machine;
            None = no Ray.
        cpus: CPU cores that Ray reserves for a worker.
        gpus: GPUs that Ray reserves for a worker; 0.5 = two workers share one.
        reads: files and folders that jobs read; every machine of the cluster must have them.
        writes: folder that jobs write to; every machine of the cluster must see the same one.
            None = results come back to this process.
    """

    count: int = 1
    threads: int = 0
    ray: str | None = None
    cpus: int = 1
    gpus: float = 0.0
    reads: tuple[Path, ...] = ()
    writes: Path | None = None

    @property
    def are_here(self) -> bool:
        """Whether this process runs the jobs itself."""
        return self.count == 1 and self.ray is None

    @property
    def num_threads(self) -> int:
        """Number of CPU threads of each worker."""
        if self.threads:
            return self.threads
        return threads_each(self.count) if self.ray is None else max(self.cpus, 1)


#: this process runs the jobs itself, on one thread
IN_PROCESS = Workers(threads=1)
