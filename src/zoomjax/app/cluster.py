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
from concurrent.futures import CancelledError, Executor
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
        ConnectionError: no scheduler answers, or it goes away in the middle.
        ValueError: workers have another version of this package.
    """
    if address is None:
        yield None
        return
    with contextlib.closing(_client(address)) as client:
        workers = _checked_workers(client, address)
        if not quiet:
            _tell(client, address, workers)
        with _told_if_gone(address):
            yield client.get_executor(pure=False)


@contextlib.contextmanager
def _told_if_gone(address: str) -> Iterator[None]:
    """A scheduler that goes away in the middle cancels all tasks, of which the work then tells."""
    try:
        yield
    except RuntimeError as error:
        if not isinstance(error.__cause__, CancelledError):
            raise
        raise ConnectionError(
            f"The scheduler of Dask at {address} has gone away. Start it again, and the command after it: "
            "detections are cached, and with zoomjax undistort --resume photos that are corrected are left."
        ) from error


def _client(address: str) -> Any:
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise ImportError('Argument cluster needs Dask: pip install "zoomjax[cluster]"') from error
    _silence("distributed", "tornado")  # the scheduler sees to workers that die, and the rest is said here
    try:
        _check_answer(urllib.parse.urlsplit(address if "://" in address else f"tcp://{address}"))
        return distributed.Client(address, timeout=_SECONDS, set_as_default=False)
    except Exception as error:  # of many kinds, such as of TLS that is not set up
        raise ConnectionError(
            f"Argument cluster is {address!r}, but no scheduler of Dask answers there: give the address "
            "that it prints when it starts, such as tcp://192.168.0.5:8786."
        ) from error


def _check_answer(place: urllib.parse.SplitResult) -> None:
    """Refuse an address where nobody answers, or something else than Dask.

    A client of Dask that is not answered waits without end, or leaves threads and messages behind.

    Raises:
        OSError, ValueError, OverflowError: nobody answers, or not as Dask does.
    """
    with socket.create_connection((place.hostname or "", place.port or 0), _SECONDS) as opened:
        if place.scheme != "tcp":
            return
        opened.settimeout(_SECONDS)
        begins = b""  # Dask speaks first, the length of what it says before all else
        while len(begins) < _LENGTH:
            if not (more := opened.recv(_LENGTH - len(begins))):
                raise ValueError
            begins += more
        if int.from_bytes(begins, "little") > _LONGEST:
            raise ValueError


_LENGTH, _LONGEST = 8, 2**20


def _silence(*libraries: str) -> None:
    """Let loggers of libraries be still, also those of their parts that have a level of their own."""
    known = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] in libraries]
    for name in {*libraries, *known}:
        logging.getLogger(name).setLevel(logging.CRITICAL)


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
