"""The file of a journal: what is committed, asked and forgotten, and what becomes of a file that is none."""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.services.journal.kit import grant, past
from zscout.messages import UNHEARD, HistoryAsk, JournalGap, ReasonParty, Who
from zscout.services.journal.follower import Change, ClockSet, EndMissed, GapSeen, HoldOver, HoldSeen, HoldUsed
from zscout.services.journal.store import ASIDE, FILE, MAX_KEPT_GAPS, JournalStore, Unwritable

BEFORE_USE = """
PRAGMA auto_vacuum = INCREMENTAL;
PRAGMA journal_mode = WAL;
CREATE TABLE holds (
    id INTEGER PRIMARY KEY, term INTEGER NOT NULL, rcm TEXT NOT NULL, seq INTEGER NOT NULL,
    request TEXT NOT NULL, arc TEXT NOT NULL, client TEXT NOT NULL, owner TEXT NOT NULL, rcs TEXT NOT NULL,
    began REAL NOT NULL, late INTEGER NOT NULL, ended REAL, outcome TEXT NOT NULL, reason TEXT NOT NULL, taken_for TEXT,
    priority INTEGER NOT NULL, min_runtime REAL, waited REAL, user TEXT, host TEXT, command TEXT,
    UNIQUE (term, rcm, seq)
);
CREATE INDEX holds_asked ON holds (began, ended, owner, user, rcs);
CREATE INDEX holds_arc ON holds (arc);
CREATE INDEX holds_request ON holds (request);
CREATE INDEX holds_ended ON holds (ended);
CREATE TABLE gaps (began REAL NOT NULL, ended REAL NOT NULL, cause TEXT NOT NULL, count INTEGER NOT NULL);
CREATE TABLE facts (name TEXT PRIMARY KEY, at REAL NOT NULL);
PRAGMA user_version = 1;
INSERT INTO holds VALUES
    (1, 1, 'rcm', 1, 'id-1', 'survey', 'desk/one', 'desk', 'robot/a', 999970.0, 0, NULL, '', '', NULL, 0, 60.0, 0.0,
     NULL, NULL, NULL);
INSERT INTO facts VALUES ('since', 999000.0), ('heard', 1000000.0);
"""
"""A file of the version before."""
DAY = 86_400.0
NOW = 1_000_000.0


def opened(folder: Path, max_age: float = 90 * DAY, max_size: int = 64_000_000) -> JournalStore:
    store = JournalStore(folder, max_age, max_size)
    store.open()
    return store


def commit(store: JournalStore, *changes: Change, now: float = NOW) -> None:
    store.commit(changes, now - 50.0, now, now)


def arcs(store: JournalStore, now: float = NOW, **asked: object) -> list[int]:
    """The numbers of the holds that are found, the latest first."""
    return [hold.grant.seq for hold in store.answer("anvil", HistoryAsk(**asked), now).holds]  # type: ignore[arg-type]


def test_a_hold_is_kept_whole(tmp_path: Path) -> None:
    store = opened(tmp_path)
    by = ReasonParty("id-take", "take", "desk/two", 10, Who("bob"))
    how = {
        "reason": "taken",
        "code": "released",
        "own": True,
        "by": by,
        "priority": 5,
        "waited": 2.5,
        "who": Who("alice", "ws1", "./x"),
    }
    whole = past(1, NOW - 20, NOW - 10, "preempted", **how)
    commit(store, HoldSeen(whole), HoldOver(whole))
    answer = store.answer("anvil", HistoryAsk(), NOW)
    assert answer.holds == [whole]
    assert (answer.host, answer.now, answer.since, answer.next) == ("anvil", NOW, NOW - 50.0, None)
    # And when it is opened again.
    store.close()
    assert opened(tmp_path).answer("anvil", HistoryAsk(), NOW).holds == [whole]


def test_what_stood_is_told_when_it_is_opened(tmp_path: Path) -> None:
    store = opened(tmp_path)
    commit(store, HoldSeen(past(1, 10.0)), HoldSeen(past(2, 11.0)), HoldOver(past(1, 10.0, 12.0, "released")))
    store.close()
    assert JournalStore(tmp_path, DAY, 10**7).open() == ([grant(2)], NOW)
    assert (tmp_path / FILE).stat().st_mode & 0o777 == 0o600


def test_news_correct_what_was_taken_for_over(tmp_path: Path) -> None:
    store, (hold,) = opened(tmp_path), [past(1, NOW - 30)]
    commit(store, HoldSeen(hold), EndMissed(grant(1), NOW - 10), EndMissed(grant(7), NOW))
    (kept,) = store.answer("anvil", HistoryAsk(), NOW).holds
    assert (kept.ended, kept.outcome) == (NOW - 10, UNHEARD)
    # It was named again: it stands.
    commit(store, HoldSeen(past(1, NOW - 5, late=True)))
    assert store.answer("anvil", HistoryAsk(), NOW).holds == [hold]
    commit(store, EndMissed(grant(1), NOW - 4), HoldOver(past(1, NOW, NOW - 3, "completed")))
    # What ended by name does so once.
    commit(store, HoldOver(past(1, NOW, NOW, "lost")), EndMissed(grant(1), NOW), HoldSeen(hold))
    (kept,) = store.answer("anvil", HistoryAsk(), NOW).holds
    assert (kept.began, kept.ended, kept.outcome) == (NOW - 30, NOW - 3, "completed")


def used(store: JournalStore) -> list[dict[str, float]]:
    return [hold.used for hold in store.answer("anvil", HistoryAsk(), NOW).holds]


def test_how_long_rcs_were_used_only_grows(tmp_path: Path) -> None:
    store = opened(tmp_path)
    gang = past(1, NOW - 30, rcs=["robot/a", "radio/b", "video/c"])
    commit(store, HoldSeen(gang), HoldUsed(grant(1), "radio/b", 0.0), HoldUsed(grant(1), "video/c", 1234567.125))
    commit(store, HoldUsed(grant(1), "radio/b", 2.5), HoldUsed(grant(1), "video/c", 3.0))
    # Of an RC that is none of it, and of a hold that there is not, nothing is kept.
    commit(store, HoldUsed(grant(1), "robot/z", 2.0), HoldUsed(grant(7), "robot/a", 2.0))
    assert used(store) == [{"radio/b": 2.5, "video/c": 1234567.125}]
    commit(store, HoldOver(past(1, NOW, NOW - 3, "completed")), HoldUsed(grant(1), "robot/a", 0.25), HoldSeen(gang))
    store.close()
    assert used(opened(tmp_path)) == [{"robot/a": 0.25, "radio/b": 2.5, "video/c": 1234567.125}]


def test_a_journal_of_before_there_was_use_is_read_on(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / FILE)) as db:
        db.executescript(BEFORE_USE)
    store = JournalStore(tmp_path, 90 * DAY, 64_000_000)
    assert store.open() == ([grant(1)], NOW)
    commit(store, HoldUsed(grant(1), "robot/a", 2.5), HoldSeen(past(2, NOW)))
    assert arcs(store) == [2, 1]
    assert used(store) == [{}, {"robot/a": 2.5}]
    store.close()
    assert used(opened(tmp_path)) == [{}, {"robot/a": 2.5}]
    assert not (tmp_path / ASIDE).exists()
    # And by the version that wrote it.
    with closing(sqlite3.connect(tmp_path / FILE)) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (1,)
        assert db.execute("SELECT count(*) FROM holds").fetchone() == (2,)


def test_what_is_asked_for(tmp_path: Path) -> None:
    store = opened(tmp_path)
    commit(
        store,
        HoldOver(past(1, NOW - 100, NOW - 90, "completed", arc="a", who=Who("alice"))),
        HoldOver(past(2, NOW - 80, NOW - 70, "completed", arc="b", client="bob/one", rcs=["robot/ab", "radio/rf0"])),
        HoldSeen(past(3, NOW - 95, arc="c")),
    )
    assert arcs(store) == [2, 3, 1]
    assert arcs(store, rc="robot/a") == [3, 1]
    assert arcs(store, rc="robot/a$*") == [2, 3, 1]
    assert arcs(store, rc="radio/*") == [2]
    assert arcs(store, who=["alice"]) == [1]
    assert arcs(store, who=["bob", "desk"]) == [2, 3, 1]
    assert arcs(store, arc="a") == arcs(store, arc="id-1") == arcs(store, arc="desk/one/id-1") == [1]
    assert arcs(store, arc="x' OR '1'='1") == []
    assert arcs(store, since=85.0) == [2, 3]
    assert arcs(store, until=85.0) == [3, 1]
    assert arcs(store, since=96.0, until=89.0) == [3, 1]


def test_pages_go_on_where_they_ended(tmp_path: Path) -> None:
    store = opened(tmp_path)
    commit(store, *(HoldOver(past(number, NOW - 100 + number // 3, NOW, "completed")) for number in range(25)))
    found, before, pages = [], None, 0
    while pages == 0 or before is not None:
        page = store.answer("anvil", HistoryAsk(limit=10, before=before), NOW)
        found += [hold.grant.seq for hold in page.holds]
        before, pages = page.next, pages + 1
    assert (found, pages) == ([*range(24, -1, -1)], 3)


def test_an_answer_has_no_more_bytes_than_others_read(tmp_path: Path) -> None:
    store = opened(tmp_path)
    wide = [f"robot/{'x' * 60}{number}" for number in range(1_000)]
    commit(store, *(HoldOver(past(number, NOW, NOW, "completed", rcs=wide)) for number in range(40)))
    page = store.answer("anvil", HistoryAsk(), NOW)
    assert 10 <= len(page.holds) < 20
    assert page.next is not None


def test_what_is_too_old_is_forgotten(tmp_path: Path) -> None:
    store = opened(tmp_path, max_age=DAY)
    old, standing = past(1, NOW - 5, NOW - 4, "completed"), past(2, NOW - 5)
    commit(store, HoldOver(old), HoldSeen(standing), GapSeen(JournalGap(NOW - 6, NOW - 5, "off")))
    later = NOW + DAY
    commit(store, now=later)
    answer = store.answer("anvil", HistoryAsk(), later)
    assert [hold.grant.seq for hold in answer.holds] == [2]
    assert (answer.since, answer.gaps) == (NOW, [])


def test_the_file_stays_within_its_size(tmp_path: Path) -> None:
    limit = 700_000
    store = opened(tmp_path, max_size=limit)
    for burst in range(20):
        at = NOW + burst
        commit(
            store,
            *(HoldOver(past(burst * 500 + one, at, at, "completed", reason="r" * 100)) for one in range(500)),
            now=at,
        )
        assert store.size() < 1.2 * limit
    assert store.size() <= limit
    assert (tmp_path / FILE).stat().st_size < 1.5 * limit
    found = store.answer("anvil", HistoryAsk(), NOW + 20)
    assert found.holds[0].grant.seq == 9_999
    assert found.since is not None
    assert found.since > NOW
    for _ in range(3):
        commit(store, *(GapSeen(JournalGap(NOW, NOW + 60, "missed", 1)) for _ in range(MAX_KEPT_GAPS)), now=NOW + 60)
    db = sqlite3.connect(tmp_path / FILE)
    assert db.execute("SELECT count(*) FROM gaps").fetchone() == (MAX_KEPT_GAPS,)


@pytest.mark.parametrize("content", [b"no database " * 500, b"SQLite format 3\0" + b"\xff" * 4_096])
def test_a_file_that_is_none_is_set_aside_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes
) -> None:
    (tmp_path / FILE).write_bytes(content)
    store = JournalStore(tmp_path, DAY, 10**7)
    assert store.open() == ([], None)
    commit(store, HoldSeen(past(1, NOW)))
    assert arcs(store) == [1]
    assert (tmp_path / ASIDE).read_bytes() == content
    (warning,) = caplog.records
    assert warning.levelno == logging.WARNING
    assert ASIDE in warning.message


def test_a_file_that_is_damaged_later_is_set_aside_too(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = opened(tmp_path)
    commit(store, *(HoldOver(past(number, NOW, NOW, "completed")) for number in range(5_000)))
    store.close()
    whole = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(whole[:8_192] + b"\xff" * (len(whole) - 8_192))
    store = opened(tmp_path)
    assert arcs(store) == []
    assert len(caplog.records) == 1


def test_a_file_of_another_format_is_set_aside(tmp_path: Path) -> None:
    db = sqlite3.connect(tmp_path / FILE)
    db.execute("PRAGMA user_version = 99")
    db.close()
    commit(opened(tmp_path), HoldSeen(past(1, NOW)))
    assert (tmp_path / ASIDE).exists()


def test_where_nothing_can_be_written_it_says_so(tmp_path: Path) -> None:
    (tmp_path / FILE).mkdir()
    with pytest.raises(Unwritable, match="unable to open"):
        JournalStore(tmp_path, DAY, 10**7).open()


def test_what_another_process_has_locked_is_tried_again(tmp_path: Path) -> None:
    store = opened(tmp_path)
    other = sqlite3.connect(tmp_path / FILE, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(Unwritable, match="locked"):
        commit(store, HoldSeen(past(1, NOW)))
    other.execute("COMMIT")
    commit(store, HoldSeen(past(1, NOW)))
    assert arcs(store) == [1]


@pytest.mark.parametrize("by", [30 * DAY, -2 * DAY], ids=["forward", "back"])
def test_a_clock_that_is_set_moves_the_beginnings_of_holds_that_stand(tmp_path: Path, by: float) -> None:
    store = opened(tmp_path)
    commit(store, HoldSeen(past(1, NOW - 400)))
    store.close()
    store = opened(tmp_path)  # that hold began by another clock
    over = HoldOver(past(2, NOW - 20, NOW - 20, "completed", late=True))
    commit(store, HoldSeen(past(2, NOW - 300)), over, HoldSeen(past(3, NOW - 200)), HoldSeen(past(4, NOW - 100)))
    commit(store, EndMissed(grant(4), NOW - 10), ClockSet(by))
    commit(store, HoldOver(past(3, NOW + by, NOW + by, "completed", late=True)), now=NOW + by)
    found = {hold.grant.seq: hold for hold in store.answer("anvil", HistoryAsk(), NOW + 31 * DAY).holds}
    assert {seq: hold.began - NOW for seq, hold in found.items()} == {1: -400, 2: -300, 3: by - 200, 4: by - 100}
    assert {seq: hold.ended - hold.began for seq, hold in found.items() if hold.ended} == {2: 280, 3: 200, 4: 90}
