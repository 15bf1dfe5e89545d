"""A cluster of Dask for the command line: ``--cluster tcp://HOST:PORT``.

Dask hands tasks to workers, and again to others when a worker dies. What a task is, and that little comes
back, is the library's: it takes any executor of `concurrent.futures`.
"""

import contextlib
import importlib.metadata
import logging
import socket
import urllib.parse
from collections.abc import Iterator
from concurrent.futures import Executor
from typing import Any

_SECONDS = 10
"""After which a scheduler that does not answer is not there."""


@contextlib.contextmanager
def cluster_executor(address: str | None, *, quiet: bool = False) -> Iterator[Executor | None]:
    """For the time of the block, an executor of the cluster whose scheduler has this address.

    None for None. How many workers there are, and the address of Dask's dashboard, is printed on stderr,
    unless `quiet`.

    Raises:
        ImportError: Dask is not installed here, or this package not where the workers are.
        ConnectionError: no scheduler answers.
        ValueError: workers have another version of this package.
    """
    if address is None:
        yield None
        return
    with contextlib.closing(_client(address)) as client:
        workers = _checked_workers(client, address)
        if not quiet:
            _tell(client, address, workers)
        yield client.get_executor(pure=False)


def _client(address: str) -> Any:
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise ImportError('Argument cluster needs Dask: pip install "zoomjax[cluster]"') from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the scheduler sees to workers that die
    try:
        place = urllib.parse.urlsplit(address if "://" in address else f"tcp://{address}")
        # A client of Dask that is not answered leaves threads and messages behind.
        socket.create_connection((place.hostname or "", place.port or 0), _SECONDS).close()
        return distributed.Client(address, timeout=_SECONDS, set_as_default=False)
    except (OSError, ValueError, OverflowError) as error:
        raise ConnectionError(
            f"Argument cluster is {address!r}, but no scheduler of Dask answers there: give the address "
            "that it prints when it starts, such as tcp://192.168.0.5:8786."
        ) from error


def _checked_workers(client: Any, address: str) -> int:
    """The number of workers, which have this version of this package."""
    own = _own_version()
    found = client.run(importlib.metadata.version, "zoomjax", on_error="return")
    for worker, version in found.items():
        if isinstance(version, importlib.metadata.PackageNotFoundError):
            raise ImportError(
                f"The worker {worker} of the cluster at {address} has no zoomjax: install version {own} "
                "there."
            )
        if version != own:
            raise ValueError(
                f"The worker {worker} of the cluster at {address} has zoomjax {version}, and here it is "
                f"{own}: install the same version there."
            )
    return len(found)


def _own_version() -> str:
    return importlib.metadata.version("zoomjax")


def _tell(client: Any, address: str, workers: int) -> None:
    from rich.console import Console

    has_one = "dashboard" in client.scheduler_info(n_workers=0).get("services", {})
    dashboard = f", dashboard {client.dashboard_link}" if has_one else ""
    number = f"{workers} worker{'s' * (workers != 1)}" if workers else "no workers yet"
    Console(stderr=True).print(f"  [dim]{address}: {number}{dashboard}[/dim]", highlight=False)
