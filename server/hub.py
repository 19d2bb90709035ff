"""Fan-out to many clients: each gets the newest message of each topic at its own rate, and none can hold up another.

A message for a client that has not taken the earlier ones is dropped, not queued: what it misses, the next message
says better. A client that takes nothing at all for `STALL_LIMIT` is cut off. (Keepalive would not do it: it waits in
drain, behind the very buffer that does not empty.)
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field

# Seconds without any progress after which a client is cut off.
STALL_LIMIT = 5.0

# What a message is about, in words such as ("smooth", "rover", "json").
Topic = tuple[str, ...]


@dataclass(eq=False, slots=True)
class Subscription:
    """One client. `write` puts a message into its buffer at once, `waiting` says how many bytes are in there, `abort`
    ends the connection. `room`: bytes that may wait before messages are dropped."""

    write: Callable[[bytes], None]
    waiting: Callable[[], int]
    abort: Callable[[], None]
    topics: tuple[Topic, ...]
    interval: float
    room: int
    due: float = 0.0
    stalled_since: float | None = None

    def sent(self, now: float) -> None:
        """A message has gone out."""
        # On schedule, so that 25 Hz out of 60 Hz is 25 Hz on average; but no catching up after a pause.
        due = self.due + self.interval
        self.due = due if due > now else now + self.interval


@dataclass
class Hub:
    """All clients. Time is an argument: s of one monotonic clock. `tick`: s between regular calls of `publish`."""

    tick: float = 0.0
    subscriptions: list[Subscription] = field(default_factory=list)
    dropped: int = 0
    cut_off: int = 0

    @contextlib.contextmanager
    def subscribed(
        self,
        write: Callable[[bytes], None],
        waiting: Callable[[], int],
        abort: Callable[[], None],
        topics: Collection[Topic] = (),
        rate_hz: float = 0.0,
        room: int = 0,
    ) -> Iterator[Subscription]:
        """`rate_hz` 0: every message. `room` 0: strictly the latest, nothing is added to what has not left yet."""
        interval = 1.0 / rate_hz if rate_hz > 0.0 else 0.0
        subscription = Subscription(write, waiting, abort, tuple(dict.fromkeys(topics)), interval, room)
        self.subscriptions.append(subscription)
        try:
            yield subscription
        finally:
            self.subscriptions.remove(subscription)

    def wants(self, topic: Topic) -> bool:
        return any(topic in subscription.topics for subscription in self.subscriptions)

    def is_due(self, now: float, subscription: Subscription, *, answer: bool = False) -> bool:
        """Whether a message may go out. `answer`: to what just came, ahead of its time by up to one interval; the next
        one is then due as if it had been sent on time, so that the rate stays what it is."""
        # Else at the nearest tick: one who wants every tick, and had to be due to the millisecond, would miss the next
        # one after each that is late.
        early = 0.5 * self.tick + (subscription.interval if answer else 0.0)
        return now >= subscription.due - early

    def publish(self, now: float, message: Callable[[Topic], bytes | None]) -> None:
        """`message`: what there is of a topic, encoded. It is asked once for each that a client is due for; what a
        client gets in one call counts as one for its rate."""
        messages: dict[Topic, bytes | None] = {}
        for subscription in self.subscriptions:
            if not self.is_due(now, subscription):
                continue
            for topic in subscription.topics:
                if topic not in messages:
                    messages[topic] = message(topic)
            wanted = [data for topic in subscription.topics if (data := messages[topic]) is not None]
            if wanted:
                self.send(now, subscription, *wanted)

    def send(self, now: float, subscription: Subscription, *messages: bytes) -> None:
        """To one client that is due."""
        if subscription.waiting() > subscription.room:
            self.dropped += len(messages)
            return
        subscription.sent(now)
        for message in messages:
            subscription.write(message)

    def sweep(self, now: float) -> list[Subscription]:
        """Cut off the clients that have taken nothing for `STALL_LIMIT`, and return them. To be called regularly."""
        stalled = []
        for subscription in self.subscriptions:
            if subscription.waiting() <= subscription.room:
                subscription.stalled_since = None
            elif subscription.stalled_since is None:
                subscription.stalled_since = now
            elif now - subscription.stalled_since > STALL_LIMIT:
                stalled.append(subscription)
        for subscription in stalled:
            self.cut_off += 1
            subscription.abort()
        return stalled
