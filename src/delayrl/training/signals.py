"""Stop at a good moment instead of in the middle of a step."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_signal() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C or SIGTERM sets. Off the main thread nothing sets it.

    Nobody looks at the event while something compiles, so a second Ctrl-C ends the program. A second SIGTERM does not:
    cluster schedulers send one to each process, and a runner another to its workers.
    """
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.getsignal(number) for number in signals}

    def ask(number: int, _: FrameType | None) -> None:
        event.set()
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, handlers[signal.SIGINT])

    try:
        for number in signals:
            signal.signal(number, ask)
        yield event
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
