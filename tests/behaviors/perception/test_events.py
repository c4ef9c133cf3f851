"""From sightings to events."""

from __future__ import annotations

from zscout.behaviors.perception.motion import Box, Event, EventTracker, Seen, around

STILL = Seen(False)
A, B, BIG = Box(10, 10, 5, 8), Box(40, 20, 4, 4), Box(12, 10, 30, 30)


def played(tracker: EventTracker, *sights: tuple[float, Seen]) -> list[Event]:
    return [event for time, seen in sights if (event := tracker.see(time, seen)) is not None]


def test_an_event_begins_with_the_sighting_that_was_confirmed_and_ends_with_the_last() -> None:
    tracker = EventTracker()
    events = played(
        tracker,
        (0.0, STILL),
        (1.0, Seen(False, (A,))),
        (1.2, Seen(True, (BIG, B))),
        (1.4, Seen(True, (A,))),
        (1.6, STILL),
        (2.4, STILL),
        (2.5, STILL),
    )
    assert events == [Event(1.0, 1.4, 1.2, (BIG, B), Box(10, 10, 34, 30), 3)]
    assert tracker.current is None
    assert tracker.close() is None


def test_a_short_pause_goes_on_with_the_event_and_a_long_one_ends_it() -> None:
    tracker = EventTracker()
    sights = [(0.0, Seen(True, (A,))), (1.0, Seen(True, (A,))), (2.1, Seen(True, (B,))), (9.0, STILL)]
    events = played(tracker, *sights)
    assert [(event.start, event.end, event.frames) for event in events] == [(0.0, 1.0, 2), (2.1, 2.1, 1)]


def test_a_sighting_long_ago_begins_nothing() -> None:
    tracker = EventTracker()
    played(tracker, (0.0, Seen(False, (A,))), (5.0, Seen(True, (B,))))
    assert tracker.current == Event(5.0, 5.0, 5.0, (B,), B, 1)


def test_pictures_that_stay_away_end_it_as_well() -> None:
    tracker = EventTracker()
    tracker.see(3.0, Seen(True, (A,)))
    assert tracker.quiet(4.0) is None
    ended = tracker.quiet(4.1)
    assert ended is not None
    assert not ended.going_on
    assert tracker.quiet(9.0) is None


def test_what_was_not_over_says_so() -> None:
    tracker = EventTracker()
    tracker.see(3.0, Seen(True, (A,)))
    last = tracker.close()
    assert last is not None
    assert last.going_on
    assert tracker.close() is None


def test_boxes_around() -> None:
    assert around((A, B)) == Box(10, 10, 34, 14)
    assert around(()) == Box(0, 0, 0, 0)
