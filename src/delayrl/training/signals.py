"""Stop at a good moment instead of in the middle of a step."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_signal(*, patient: bool = False) -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C or SIGTERM sets. Off the main thread nothing sets it.

    Nobody looks at the event during an evaluation, so a second Ctrl-C does what it did before, unless `patient`; Python
    hears of none while XLA compiles. A second SIGTERM changes nothing: cluster schedulers send one to each process, and
    a runner another to its workers.
    """
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.getsignal(number) or signal.SIG_DFL for number in signals}

    def ask(number: int, _: FrameType | None) -> None:
        event.set()
        if number == signal.SIGINT and not patient:
            signal.signal(signal.SIGINT, handlers[signal.SIGINT])

    try:
        for number in signals:
            signal.signal(number, ask)
        yield event
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
