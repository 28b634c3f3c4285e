"""What a worker of dask does for a sweep.

At run time this module imports nothing of nlcwfs: that imports JAX, which reads its environment only then.
"""

import os
import platform
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from distributed import Worker, WorkerPlugin, get_worker

if TYPE_CHECKING:
    from nlcwfs.studies.point_run import PointResult, PointRunner
    from nlcwfs.studies.sweep_points import Point

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"
"""Matrix products of many threads in many processes fight for the cores."""


class SweepWorker(WorkerPlugin):
    """Prepares a worker, also one that joins or is started again in the midst; keeps the last loop for the next seed.

    Attributes:
        deaf: Whether Ctrl-C is for the command alone, which then ends its workers; as they share a terminal.
        name: By which the worker knows it.
        lock: A worker of many threads computes one point at a time, for precision is a setting of the process.
    """

    name = "nlcwfs-sweep"
    idempotent = True

    def __init__(self, *, deaf: bool = False) -> None:
        self.deaf = deaf

    def setup(self, worker: Worker) -> None:
        """Set the environment of JAX; what the user has set stays."""
        self.lock = threading.Lock()
        self._runner: PointRunner | None = None
        if self.deaf and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        wanted = jax_environment(os.environ.get("XLA_FLAGS", ""))
        os.environ.update({key: text for key, text in wanted.items() if key == "XLA_FLAGS" or key not in os.environ})

    def run(self, point: "Point") -> "PointResult":
        """Run a point."""
        with self.lock:
            if self._runner is None:
                from nlcwfs.studies.point_run import PointRunner

                self._runner = PointRunner()
            return self._runner.run(point)


def run_on_worker(point: "Point") -> "PointResult":
    """Run a point on the worker that dask chose."""
    plugin = get_worker().plugins[SweepWorker.name]
    return plugin.run(point)  # pyright: ignore


def jax_environment(xla_flags: str = "") -> dict[str, str]:
    """Environment of a worker: one thread, no claim on the whole GPU, and compiled code kept on disk.

    Compiled code is that of a machine, so that each has a folder of its own.

    Args:
        xla_flags: Flags that are set already.

    Examples:
        >>> jax_environment("--xla_a=1")["XLA_FLAGS"]
        '--xla_a=1 --xla_cpu_multi_thread_eigen=false'
    """
    flags = xla_flags.split()
    if not any(flag.startswith(ONE_THREAD.partition("=")[0]) for flag in flags):
        flags.append(ONE_THREAD)
    return {
        "XLA_FLAGS": " ".join(flags),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "JAX_COMPILATION_CACHE_DIR": str(cache_folder() / platform.node()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }


def cache_folder() -> Path:
    """Where compiled code is kept: `nlcwfs` in the user's cache.

    Examples:
        >>> cache_folder().parts[-2:]
        ('nlcwfs', 'compiled')
    """
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "nlcwfs" / "compiled"
