"""`python -m studies journal`: the cost of a journal of 100,000 holds: its commits, its file, its answers.

Each hold has two publications, its grant and its end, and two RCs, which report how long they were used. A commit has
as many holds as a second of a busy fleet. Answers are timed with their encoding, as by a candidate."""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

from zscout.messages import MAX_PAGE, Grants, HistoryAsk, Holder, Revocation, Who, encode
from zscout.services.journal.follower import Change, Follower, Observation, PublicationReceived, UseReported
from zscout.services.journal.store import JournalStore
from zscout.types import Grant, Place, Term

HOLDS = 100_000
PER_COMMIT = 100
"""Holds that begin and end between two commits."""
APART = 60.0
"""Seconds between holds: about three months in all."""
TERM = Term(1, "0123456789ab")
START = 1_700_000_000.0
SIZE = 10**9
AGE = 3.2e7


def publications(count: int, *, used: bool) -> Iterator[tuple[float, list[Observation]]]:
    """Yield the beginning of each hold and its observations."""
    for number in range(count):
        at, seq, client = START + APART * number, 2 * number + 1, f"ws{number % 20}/request-0123456789ab"
        grant, rcs = Grant(TERM, seq), [f"robot/scout{number % 50}", "radio/rf0"]
        who = Who(f"user{number % 30}", f"ws{number % 20}", "./survey.py --fast")
        name, arc = f"{number:012x}", f"survey-{number % 100}"
        holder = Holder(name, arc, client, grant, Place(TERM, seq), rcs, Decimal(60), 60.0, number % 5, who=who)
        instances = dict.fromkeys(rcs, "0123456789ab")
        begun = [(seq, 12.5)]
        begins = Grants(TERM, seq, seq - 1, 0.5, {rc: [holder] for rc in rcs}, [], instances, begun)
        over = Revocation(name, arc, client, grant, rcs, "completed", "its minimum runtime is over")
        free: dict[str, list[Holder]] = {rc: [] for rc in rcs}
        ends = Grants(TERM, seq + 1, seq, 0.5, free, [over], instances)
        seen: list[Observation] = [PublicationReceived(at, 0.2, begins), PublicationReceived(at + 30, 0.2, ends)]
        yield at, seen + ([UseReported([(rc, grant, 27.125) for rc in rcs])] if used else [])


def fill(store: JournalStore, count: int, *, used: bool) -> tuple[list[float], list[float]]:
    """Seconds to compute each commit's changes, and to commit them."""
    follower, observed = Follower(1e9), publications(count, used=used)
    worked, committed = [], []
    for _ in range(count // PER_COMMIT):
        batch = [next(observed) for _ in range(PER_COMMIT)]
        began = time.perf_counter()
        changes: list[Change] = [change for _, of in batch for event in of for change in follower.take(event)]
        worked.append(time.perf_counter() - began)
        began = time.perf_counter()
        store.commit(changes, START, batch[-1][0], batch[-1][0])
        committed.append(time.perf_counter() - began)
    return worked, committed


def answers(store: JournalStore, now: float) -> None:
    week = 7 * 86_400.0
    print(f"{'question':42} {'holds':>6} {'ms':>7} {'kB':>6}")
    for words, asked in (
        ("the latest 100", HistoryAsk(limit=100)),
        (f"the latest {MAX_PAGE}", HistoryAsk(limit=MAX_PAGE)),
        (f"a week, its first {MAX_PAGE}", HistoryAsk(since=week, limit=MAX_PAGE)),
        ("one RC, the latest 100", HistoryAsk(rc="robot/scout7", limit=100)),
        ("a pattern of RCs, the latest 100", HistoryAsk(rc="robot/scout1$*", limit=100)),
        ("a user, the latest 100", HistoryAsk(who=["user7"], limit=100)),
        ("an ARC by its id (the oldest)", HistoryAsk(arc=f"{0:012x}")),
        ("an unknown user (the whole file)", HistoryAsk(who=["nobody"])),
        ("a pattern without matches (the whole file)", HistoryAsk(rc="video/*")),
        ("a day two months ago", HistoryAsk(since=61 * 86_400.0, until=60 * 86_400.0, limit=MAX_PAGE)),
    ):
        spent = []
        for _ in range(5):
            began = time.perf_counter()
            answer = store.answer("anvil", asked, now)
            size = len(encode(answer))
            spent.append(time.perf_counter() - began)
        print(f"{words:42} {len(answer.holds):6} {1000 * statistics.median(spent):7.1f} {size / 1000:6.0f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--holds", type=int, default=HOLDS)
    parser.add_argument("--without-use", action="store_true", help="RCs do not report how long they were used.")
    args = parser.parse_args()
    count = args.holds
    with tempfile.TemporaryDirectory(prefix="zscout-bench-") as folder:
        store = JournalStore(Path(folder), AGE, SIZE)
        store.open()
        worked, committed = fill(store, count, used=not args.without_use)
        print(f"{count} holds in commits of {PER_COMMIT}, two publications each")
        work, commit = 1e6 * sum(worked) / count, 1e6 * sum(committed) / count
        print(f"to compute a hold: {work:.0f} us of a thread; to commit it: {commit:.0f} us")
        quick, slow = statistics.median(committed), sorted(committed)[len(committed) * 99 // 100]
        print(f"a commit: median {1000 * quick:.1f} ms, 99 of 100 within {1000 * slow:.1f} ms")
        print(f"file: {store.size() / 1e6:.1f} MB, {store.size() / count:.0f} bytes a hold")
        answers(store, START + APART * count)
        store.close()
        began = time.perf_counter()
        store.open()
        print(f"opened again and checked in {1000 * (time.perf_counter() - began):.0f} ms")
        store.close()
