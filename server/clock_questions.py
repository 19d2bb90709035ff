"""The clock exchange over one connection, of the service's side: what was asked when, and what an answer tells."""

from __future__ import annotations

import itertools

from imu.clock import DeviceClock
from imu.protocols import TIME_LIMIT
from server.messages import ClockQuestion, MessageError

# s between questions, for the first ones and then.
FAST, FAST_COUNT, SLOW = 0.1, 10, 1.0


class ClockQuestions:
    """No I/O; times are host monotonic s. `pause`: s until the next question is due."""

    def __init__(self) -> None:
        self.pause = FAST
        self._ids = itertools.count()
        # Those on the way: id -> when it was asked.
        self._asked: dict[int, float] = {}

    def ask(self, now: float) -> ClockQuestion:
        """The next question, which is to leave now."""
        id = next(self._ids)
        self.pause = FAST if id < FAST_COUNT else SLOW
        while len(self._asked) >= FAST_COUNT:
            del self._asked[next(iter(self._asked))]
        self._asked[id] = now
        return ClockQuestion(id, now)

    def take(self, id: int, received: float, sent: float, arrival: float, clock: DeviceClock) -> None:
        """An answer, its times in s of the device's clock, which came at `arrival`. Raises MessageError."""
        asked = self._asked.pop(id, None)
        if asked is None:
            raise MessageError(f"a clock answer with id {id}, which was not asked")
        if not max(abs(received), abs(sent)) < TIME_LIMIT:
            raise MessageError(f"a clock that reads {max(received, sent)} s; that is none")
        clock.exchange(asked, received, sent, arrival)
