"""A candidate's journal on disk: one SQLite file, bounded in size and age.

Calls block, and come from threads. WAL mode with a sync per commit: commits survive crashes of process and host."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import msgspec

from zscout import messages
from zscout.keyexpr import check_need, is_pattern, matcher
from zscout.services.journal.follower import Change, ClockSet, EndMissed, GapSeen, HoldOver, HoldSeen, HoldUsed
from zscout.types import Grant, RcName, Term

log = logging.getLogger(__name__)

FILE: Final = "journal.sqlite"
ASIDE: Final = "journal.damaged.sqlite"  # unreadable files; the last one only, to bound the disk
FORMAT: Final = 1  # `user_version` of the file
PRUNED_AT_ONCE: Final = 5_000  # holds removed by a commit, so that the next does not wait long
ROOM: Final = 0.95  # share of the allowed size after a removal
MAX_KEPT_GAPS: Final = 10_000
WAL: Final = 4_000_000  # bytes of the write-ahead log between commits
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)

_SCHEMA: Final = """
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
"""
_ADDED: Final = ("used TEXT", "code TEXT", "own INTEGER")
"""Added to older files when opened; older versions ignore them. `used`: seconds, one line per RC of `rcs`, empty if
unknown."""
_COLUMNS: Final = (
    "term, rcm, seq, request, arc, client, owner, rcs, began, late, ended, outcome, reason, taken_for, priority, "
    "min_runtime, waited, user, host, command, used, code, own"
)
_INSERT: Final = (
    f"INSERT INTO holds ({_COLUMNS}) VALUES ({', '.join('?' * 23)}) ON CONFLICT (term, rcm, seq) DO UPDATE SET "  # noqa: S608 - constants
)
# Complete a hold that was assumed to have ended, or of which only the end is known.
_BEGAN: Final = f"""{_INSERT}
    arc = excluded.arc, began = min(began, excluded.began), late = min(late, excluded.late),
    priority = excluded.priority, min_runtime = excluded.min_runtime, waited = coalesce(excluded.waited, waited),
    user = excluded.user, host = excluded.host, command = excluded.command,
    ended = CASE outcome WHEN '{messages.UNHEARD}' THEN NULL ELSE ended END,
    outcome = CASE outcome WHEN '{messages.UNHEARD}' THEN '' ELSE outcome END"""
_ENDED: Final = f"""{_INSERT}
    ended = max(holds.began, excluded.ended), outcome = excluded.outcome, reason = excluded.reason,
    taken_for = excluded.taken_for, code = excluded.code, own = excluded.own
    WHERE holds.ended IS NULL OR holds.outcome = '{messages.UNHEARD}'"""
_UNHEARD: Final = f"""
    UPDATE holds SET ended = max(began, ?), outcome = '{messages.UNHEARD}'
    WHERE term = ? AND rcm = ? AND seq = ? AND ended IS NULL"""  # noqa: S608 - a constant
_CLOCK_SET: Final = f"""
    UPDATE holds SET began = max(0, began + ?), ended = max(0, ended + ?)
    WHERE (ended IS NULL OR outcome = '{messages.UNHEARD}') AND id > ?"""  # noqa: S608 - a constant
_PARTY: Final = msgspec.json.Decoder(messages.ReasonParty)


class Unwritable(Exception):
    """The journal can't be written at present; the message gives the reason. A commit may be retried."""


class Damaged(Unwritable): ...


class JournalStore:
    """The file in `folder`. `max_age` in seconds, `max_size` in bytes."""

    def __init__(self, folder: Path, max_age: float, max_size: int) -> None:
        self.path = folder / FILE
        self._max_age, self._max_size = max_age, max_size
        self._db: sqlite3.Connection | None = None
        self._one = threading.Lock()
        self._before = 0  # the last hold before this process: its times are of another clock

    def open(self) -> tuple[list[Grant], float | None]:
        """The closed journal's open holds and last publication. Sets a bad file aside. Raises Unwritable."""
        with self._one:
            try:
                db = self._opened()
            except Damaged:
                db = self._opened()
            (self._before,) = db.execute("SELECT coalesce(max(id), 0) FROM holds").fetchone()
            rows = db.execute("SELECT term, rcm, seq FROM holds WHERE ended IS NULL ORDER BY id")
            return [Grant(Term(term, rcm), seq) for term, rcm, seq in rows], self._fact("heard")

    def commit(self, changes: Iterable[Change], first: float, heard: float, now: float) -> None:
        """Store all changes or none, with the last publication's time, and prune. Raises Unwritable."""
        with self._one:
            try:
                db = self._opened()
                with _transaction(db):
                    for change in changes:
                        _apply(db, change, self._before)
                    db.execute("INSERT INTO facts VALUES ('since', ?) ON CONFLICT DO NOTHING", (first,))
                    db.execute("INSERT OR REPLACE INTO facts VALUES ('heard', ?)", (heard,))
                    self._prune(db, now)
                db.execute("PRAGMA incremental_vacuum(1000)").fetchall()
            except sqlite3.Error as error:
                raise self._failed(error) from None

    def answer(self, host: str, asked: messages.HistoryAsk, now: float) -> messages.History:
        """Answer with a page. Raises Unwritable, or BadName for an invalid pattern."""
        with self._one:
            try:
                return self._answer(host, asked, now)
            except sqlite3.Error as error:
                raise self._failed(error) from None

    def latest(self, limit: int) -> list[messages.PastHold]:
        """The last holds with known start and end, oldest first. Raises Unwritable."""
        heard = f"ended IS NOT NULL AND late = 0 AND outcome <> '{messages.UNHEARD}'"
        sql = f"SELECT {_COLUMNS} FROM holds WHERE {heard} ORDER BY ended DESC LIMIT ?"  # noqa: S608 - constants
        with self._one:
            try:
                return [_hold(row) for row in reversed(self._opened().execute(sql, (limit,)).fetchall())]
            except sqlite3.Error as error:
                raise self._failed(error) from None

    def size(self) -> int:
        """Bytes of the file in use."""
        with self._one:
            return _used(self._opened())

    def close(self) -> None:
        with self._one:
            self._forget()

    def _opened(self) -> sqlite3.Connection:
        if self._db is None:
            try:
                self._db = self._open()
            except sqlite3.Error as error:
                raise self._failed(error) from None
        return self._db

    def _open(self) -> sqlite3.Connection:
        db = sqlite3.connect(self.path, timeout=1.0, isolation_level=None, check_same_thread=False)
        try:
            (version,) = db.execute("PRAGMA user_version").fetchone()
            if version == 0:
                db.execute("PRAGMA auto_vacuum = INCREMENTAL")
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            db.execute(f"PRAGMA journal_size_limit = {WAL}")
            if version == 0:
                db.executescript(f"BEGIN; {_SCHEMA} PRAGMA user_version = {FORMAT}; COMMIT;")
            elif version != FORMAT:
                raise _damaged(f"it is of format {version}, not {FORMAT}")
            (sound,) = db.execute("PRAGMA quick_check(1)").fetchone()
            if sound != "ok":
                raise _damaged(sound)
            known = {name for (name,) in db.execute("SELECT name FROM pragma_table_info('holds')")}
            for column in _ADDED:
                if column.partition(" ")[0] not in known:
                    db.execute(f"ALTER TABLE holds ADD COLUMN {column}")
            db.create_function("any_rc", 2, _any_rc, deterministic=True)
        except BaseException:
            db.close()
            raise
        self.path.chmod(0o600)
        return db

    def _failed(self, error: sqlite3.Error) -> Unwritable:
        """The error to raise; sets a damaged file aside."""
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in _DAMAGED:
            self._forget()
            aside = self.path.with_name(ASIDE)
            try:
                for end in ("", "-wal", "-shm"):
                    with suppress(FileNotFoundError):
                        self.path.with_name(FILE + end).replace(aside.with_name(ASIDE + end))
            except OSError as stays:
                return Unwritable(f"{self.path} is damaged, and can't be set aside: {stays.strerror}")
            log.warning("%s is damaged (%s): set aside as %s, starting a new file", self.path, error, aside.name)
            return Damaged(f"{self.path}: {error}")
        return Unwritable(f"{self.path}: {error}")

    def _forget(self) -> None:
        db, self._db = self._db, None
        if db is not None:
            with suppress(sqlite3.Error):
                db.close()

    def _fact(self, name: str) -> float | None:
        row = self._opened().execute("SELECT at FROM facts WHERE name = ?", (name,)).fetchone()
        return None if row is None else float(row[0])

    def _prune(self, db: sqlite3.Connection, now: float) -> None:
        """Remove the holds that ended first; the journal starts after them. Open holds are kept."""
        oldest = now - self._max_age
        over = "SELECT id, ended FROM holds WHERE ended IS NOT NULL"
        gone = db.execute(f"{over} AND ended < ? ORDER BY ended LIMIT ?", (oldest, PRUNED_AT_ONCE)).fetchall()
        if not gone and (used := _used(db)) > self._max_size:
            (count,) = db.execute("SELECT count(*) FROM holds").fetchone()
            many = round(count * (1 - ROOM * self._max_size / used)) + 1
            gone = db.execute(f"{over} ORDER BY ended LIMIT ?", (min(many, PRUNED_AT_ONCE),)).fetchall()
        if gone:
            db.executemany("DELETE FROM holds WHERE id = ?", [(number,) for number, _ in gone])
            oldest = max(oldest, gone[-1][1])
        db.execute("UPDATE facts SET at = ? WHERE name = 'since' AND at < ?", (oldest, oldest))
        db.execute("DELETE FROM gaps WHERE ended < ?", (oldest,))
        kept = "SELECT rowid FROM gaps ORDER BY rowid DESC LIMIT 1 OFFSET ?"
        db.execute(f"DELETE FROM gaps WHERE rowid <= ({kept})", (MAX_KEPT_GAPS,))  # noqa: S608 - a constant

    def _answer(self, host: str, asked: messages.HistoryAsk, now: float) -> messages.History:
        db = self._opened()
        low = 0.0 if asked.since is None else now - asked.since
        high, since = now - asked.until, self._fact("since")
        where = ["began <= ?", "(ended IS NULL OR ended >= ?)"]
        conditions: list[Any] = [high, low]
        if asked.before is not None:
            where.append("(began, id) < (?, ?)")
            conditions += asked.before
        if asked.arc is not None:
            of_arc = "SELECT id FROM holds WHERE"
            where.append(
                f"id IN ({of_arc} arc = ? UNION {of_arc} request = ? UNION {of_arc} request = ? AND client = ?)"
            )
            client, _, request = asked.arc.rpartition("/")
            conditions += [asked.arc, asked.arc, request, client]
        if asked.who:
            names = ", ".join("?" * len(asked.who))
            where.append(f"(user IN ({names}) OR owner IN ({names}))")
            conditions += [*asked.who, *asked.who]
        if asked.rc is not None:
            check_need(asked.rc)
            pattern = is_pattern(asked.rc)
            where.append("any_rc(?, rcs)" if pattern else "instr(char(10) || rcs || char(10), ?)")
            conditions.append(asked.rc if pattern else f"\n{asked.rc}\n")
        # Conditions are met within an index: only results are read from the table.
        found = f"SELECT id FROM holds WHERE {' AND '.join(where)} ORDER BY began DESC, id DESC LIMIT ?"  # noqa: S608 - texts of this function
        sql = f"SELECT id, {_COLUMNS} FROM holds WHERE id IN ({found}) ORDER BY began DESC, id DESC"  # noqa: S608
        holds: list[messages.PastHold] = []
        last: messages.Cursor = (0.0, 0)
        more: messages.Cursor | None = None
        size = 0
        for row in db.execute(sql, (*conditions, asked.limit + 1)):
            if len(holds) == asked.limit or size > messages.MAX_HISTORY_BYTES:
                more = last
                break
            hold = _hold(row[1:])
            holds.append(hold)
            last = (hold.began, row[0])
            size += 400 + len(row[8]) + len(row[13]) + len(row[14] or "")
            size += 2 * len(row[8]) if row[21] else 0
        return messages.History(host, now, since, holds, more, [] if asked.before is not None else _gaps(db, low, high))


def _gaps(db: sqlite3.Connection, low: float, high: float) -> list[messages.JournalGap]:
    sql = "SELECT began, ended, cause, count FROM gaps WHERE ended >= ? AND began <= ? ORDER BY rowid DESC LIMIT ?"
    rows = db.execute(sql, (low, high, messages.MAX_GAPS)).fetchall()
    return [messages.JournalGap(*row) for row in reversed(rows)]


def _used(db: sqlite3.Connection) -> int:
    (pages,), (free,), (size,) = (
        db.execute(f"PRAGMA {name}").fetchone() for name in ("page_count", "freelist_count", "page_size")
    )
    return int((pages - free) * size)


def _apply(db: sqlite3.Connection, change: Change, before: int) -> None:
    match change:
        case HoldSeen(hold):
            db.execute(_BEGAN, _row(hold))
        case HoldOver(hold):
            db.execute(_ENDED, _row(hold))
        case EndMissed(Grant(term, seq), at):
            db.execute(_UNHEARD, (at, term.counter, term.rcm, seq))
        case HoldUsed(grant, rc, seconds):
            _use(db, grant, rc, seconds)
        case ClockSet(by):
            db.execute(_CLOCK_SET, (by, by, before))
        case GapSeen(gap):
            db.execute("INSERT INTO gaps VALUES (?, ?, ?, ?)", (gap.began, gap.ended, gap.cause, gap.count))


def _use(db: sqlite3.Connection, grant: Grant, rc: RcName, seconds: float) -> None:
    sql = "SELECT id, rcs, used FROM holds WHERE term = ? AND rcm = ? AND seq = ?"
    row = db.execute(sql, (grant.term.counter, grant.term.rcm, grant.seq)).fetchone()
    rcs = row[1].split("\n") if row is not None else []
    known = _used_by_rc(rcs, row[2]) if row is not None else {}
    if rc in rcs and seconds > known.get(rc, -1.0):
        db.execute("UPDATE holds SET used = ? WHERE id = ?", (_used_text(rcs, known | {rc: seconds}), row[0]))


def _used_text(rcs: list[str], used: Mapping[RcName, float]) -> str | None:
    return "\n".join(f"{round(used[rc], 3)}" if rc in used else "" for rc in rcs) if used else None


def _used_by_rc(rcs: list[str], text: str | None) -> dict[RcName, float]:
    return {rc: float(seconds) for rc, seconds in zip(rcs, (text or "").split("\n"), strict=False) if seconds}


def _row(hold: messages.PastHold) -> tuple[object, ...]:
    (counter, rcm), seq = hold.grant
    who, owner = hold.who or messages.Who(), hold.client.partition("/")[0]
    by = None if hold.by is None else msgspec.json.encode(hold.by).decode()
    names = counter, rcm, seq, hold.id, hold.arc, hold.client, owner, "\n".join(hold.rcs)
    times = hold.began, hold.late, hold.ended, hold.outcome, hold.reason, by
    asked = hold.priority, hold.min_runtime, hold.waited, who.user or None, who.host or None, who.command or None
    return *names, *times, *asked, _used_text(hold.rcs, hold.used), hold.code or None, hold.own


def _hold(row: tuple[Any, ...]) -> messages.PastHold:
    (term, rcm, seq, number, arc, client, _, rcs, began, late, ended, outcome, reason, by, priority, runtime) = row[:16]
    waited, user, host, command, used, code, own = row[16:]
    grant, held = Grant(Term(term, rcm), seq), rcs.split("\n") if rcs else []
    by = None if by is None else _PARTY.decode(by)
    who = messages.Who(user or "", host or "", command or "") if user or host or command else None
    times, asked = (began, bool(late), ended, outcome, reason), (priority, runtime, waited, who)
    used_by_rc = _used_by_rc(held, used)
    return messages.PastHold(
        grant, number, arc, client, held, *times, by, *asked, used_by_rc, code=code or "", own=bool(own)
    )


@lru_cache(4_096)
def _any_rc(pattern: str, rcs: str) -> bool:
    return any(map(matcher(pattern), rcs.split("\n")))


@contextmanager
def _transaction(db: sqlite3.Connection) -> Iterator[None]:
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        with suppress(sqlite3.Error):
            db.execute("ROLLBACK")
        raise
    db.execute("COMMIT")


def _damaged(why: str) -> sqlite3.DatabaseError:
    error = sqlite3.DatabaseError(why)
    error.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
    return error
