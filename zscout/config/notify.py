"""The table [notify] of a node file: notifications to people, with their events and URLs. The URLs are secrets: no
error, log line or `repr` shows them."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple, get_args

from msgspec import Meta, Struct

from zscout.config.apprise_process import NoAnswer, usable
from zscout.config.packages import check_installed
from zscout.config.strict import BadInput, Where, key, quoted, read_text, seconds, secret
from zscout.types import SECOND, Ns

MAX_URLS: Final = 20
"""URLs in one list."""
MAX_USERS: Final = 200
MAX_URL: Final = 2_000
"""Characters."""
MAX_NAME: Final = 64

NotifyEvent = Literal["yours_now", "preempted", "device_unwell", "booking_in_danger", "certificate_ends"]
EVENTS: Final[tuple[NotifyEvent, ...]] = get_args(NotifyEvent)
Urls = Annotated[tuple[str, ...], Meta(max_length=MAX_URLS)]


class Address(Struct, frozen=True):
    """A URL, and its place in the file (`notify.urls[0]`), which may be shown."""

    at: str
    url: str

    def __repr__(self) -> str:
        return f"Address({self.at})"


class _Written(NamedTuple):
    """A URL and its place in a file."""

    url: str
    where: Where
    line: str = ""


class NotifyTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [notify]. With it this node sends notifications to people while it leads."""

    urls: Annotated[
        Urls,
        secret('texts in a list, as in ["mailtos://user:password@example.org"]'),
        key("Apprise URLs that get all `events`; an entry without `://` names a file with URLs."),
    ] = ()
    events: Annotated[
        Annotated[tuple[NotifyEvent, ...], Meta(max_length=len(EVENTS))], key("Events sent to `urls`.")
    ] = EVENTS
    users: Annotated[
        Annotated[Mapping[str, Urls], Meta(max_length=MAX_USERS)],
        secret('a table of lists, as in users = { ada = ["ntfys://ada-lab"] }'),
        key("By user: URLs that get the events of this user's requests and bookings."),
    ] = {}
    after: Annotated[Ns, seconds("0", "86400", "`yours_now`: only after a wait this long.")] = 60 * SECOND
    per_minute: Annotated[int, key("Notifications to one URL at most; the rest is dropped.", 1, 600)] = 20


class NotifyConfig(Struct, frozen=True):
    """The table [notify] with its files read."""

    urls: tuple[Address, ...]
    events: tuple[NotifyEvent, ...]
    users: Mapping[str, tuple[Address, ...]]
    after: Ns
    per_minute: int


def read_notify(table: NotifyTable, folder: Path, at: Where) -> NotifyConfig:
    """Read the files that the table names, and check all URLs; `folder`: of the node file. Raises BadInput."""
    check_installed("apprise", at)
    if not table.urls and not table.users:
        raise at.bad("has neither urls nor users", "add either, or remove the table")
    for user in table.users:
        if not user or len(user) > MAX_NAME or not user.isprintable():
            raise (at / "users").bad(
                f"{quoted(user)} is not a user name", f"write 1 to {MAX_NAME} printable characters"
            )
    shared = [*_written(table.urls, folder, at / "urls")]
    by_user = {user: [*_written(urls, folder, at / "users" / user)] for user, urls in table.users.items()}
    distinct = dict.fromkeys(written.url for urls in (shared, *by_user.values()) for written in urls)
    try:
        known = {url for url, is_usable in zip(distinct, usable([*distinct]), strict=True) if is_usable}
    except NoAnswer as error:
        raise at.bad(f"can't be checked: {error}", "try apprise yourself: apprise --dry-run -b test URL") from None
    users = {user: tuple(_address(written, known) for written in urls) for user, urls in by_user.items()}
    urls = tuple(_address(written, known) for written in shared)
    return NotifyConfig(urls, table.events, users, table.after, table.per_minute)


def _written(urls: tuple[str, ...], folder: Path, at: Where) -> Iterator[_Written]:
    for number, url in enumerate(urls):
        here = at.item(number)
        if "://" in url:
            yield _Written(url, here)
            continue
        file = folder / _file_name(url, here)
        try:
            lines = read_text(file, max_bytes=MAX_URLS * MAX_URL).splitlines()
        except BadInput as error:
            named_by = f"{here.source}: {here.key}"
            raise BadInput(f"{error} (named by {named_by})") from None
        found = [(count, line.strip()) for count, line in enumerate(lines, 1)]
        found = [(count, line) for count, line in found if line and not line.startswith("#")]
        if not 0 < len(found) <= MAX_URLS:
            raise here.bad(f"{quoted(url)} has {len(found)} URLs", f"write 1 to {MAX_URLS}, one on each line")
        for count, line in found:
            yield _Written(line, Where(str(folder / url)), f"line {count} ")


def _file_name(text: str, at: Where) -> str:
    if not re.fullmatch(r"[\w./-]{1,255}", text):
        # The text may be a mistyped URL, so the error does not show it.
        raise at.bad("is neither a URL nor the name of a file", "write one, as in mailtos://user:password@example.org")
    return text


def _address(written: _Written, known: Container[str]) -> Address:
    url, at, line = written
    what = ""
    if len(url) > MAX_URL or not url.isprintable():
        what = "is too long, or not printable"
    elif url not in known:
        what = "is not a URL that Apprise supports (not shown: it may hold a secret)"
    if what:
        raise at.bad(f"{line}{what}", "https://appriseit.com shows the form for each service")
    return Address(at.key or f"{at.source} {line}".strip(), url)
