"""Work ahead in a thread: a generator whose items are made while earlier ones are used."""

import queue
import threading
from collections.abc import Generator
from typing import Any

_DEPTH = 4
"""Items that wait to be used: enough to even out uneven ones, and 12 MB of 1080p video."""

_END = object()


def ahead(items: Generator[Any, None, None]) -> Generator[Any, None, None]:
    """The same items, made in a thread of their own, a few before they are asked for.

    An error in the thread is raised here, after the items before it. Closing this generator, also by an
    exception where it is used, stops the thread, closes `items` in it, and waits for both.
    """
    ready: queue.Queue[tuple[Any, BaseException | None]] = queue.Queue(_DEPTH)
    stop = threading.Event()

    def put(item: Any, error: BaseException | None = None) -> None:
        while not stop.is_set():
            try:
                return ready.put((item, error), timeout=0.05)
            except queue.Full:
                continue
        return None

    def work() -> None:
        try:
            for item in items:
                put(item)
                if stop.is_set():
                    return
            put(_END)
        except BaseException as error:
            put(_END, error)
        finally:
            items.close()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while True:
            item, error = ready.get()
            if error is not None:
                raise error
            if item is _END:
                return
            yield item
    finally:
        stop.set()
        thread.join()
