"""The table [notify] of a node file: who is told of what, and where. Its URLs are secrets: no error, log line or `repr`
shows one."""

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
"""In one list."""
MAX_USERS: Final = 200
MAX_URL: Final = 2_000
"""Characters."""
MAX_NAME: Final = 64

NotifyEvent = Literal["yours_now", "preempted", "device_unwell", "booking_in_danger", "certificate_ends"]
EVENTS: Final[tuple[NotifyEvent, ...]] = get_args(NotifyEvent)
Urls = Annotated[tuple[str, ...], Meta(max_length=MAX_URLS)]


class Address(Struct, frozen=True):
    """A URL, and where it stands: `notify.urls[0]`, which may be shown."""

    at: str
    url: str

    def __repr__(self) -> str:
        return f"Address({self.at})"


class _Written(NamedTuple):
    """A URL as it stands in a file."""

    url: str
    where: Where
    line: str = ""


class NotifyTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [notify]. With it this node tells people what happens, while it leads."""

    urls: Annotated[
        Urls,
        secret('texts in a list, as in ["mailtos://user:password@example.org"]'),
        key("Apprise URLs that hear of all `events`; one without `://` is a file of such."),
    ] = ()
    events: Annotated[
        Annotated[tuple[NotifyEvent, ...], Meta(max_length=len(EVENTS))], key("Of which `urls` hear.")
    ] = EVENTS
    users: Annotated[
        Annotated[Mapping[str, Urls], Meta(max_length=MAX_USERS)],
        secret('a table of lists, as in users = { ada = ["ntfys://ada-lab"] }'),
        key("By user: who hears of that user's requests and bookings."),
    ] = {}
    after: Annotated[Ns, seconds("0", "86400", "`yours_now`: only after a wait of so long.")] = 60 * SECOND
    per_minute: Annotated[int, key("Sent to one URL at most; the rest is left out.", 1, 600)] = 20


class NotifyConfig(Struct, frozen=True):
    """Who is told of what."""

    urls: tuple[Address, ...]
    events: tuple[NotifyEvent, ...]
    users: Mapping[str, tuple[Address, ...]]
    after: Ns
    per_minute: int


def read_notify(table: NotifyTable, folder: Path, at: Where) -> NotifyConfig:
    """The table, with what its files hold; `folder` is that of the node file. Raises BadInput."""
    check_installed("apprise", at)
    if not table.urls and not table.users:
        raise at.bad("sends nothing to anybody", "name urls or users, or remove the table")
    for user in table.users:
        if not user or len(user) > MAX_NAME or not user.isprintable():
            raise (at / "users").bad(f"{quoted(user)} is not a user", f"write 1 to {MAX_NAME} printable characters")
    heard = [*_written(table.urls, folder, at / "urls")]
    by_user = {user: [*_written(urls, folder, at / "users" / user)] for user, urls in table.users.items()}
    every = dict.fromkeys(one.url for some in (heard, *by_user.values()) for one in some)
    try:
        known = {url for url, is_one in zip(every, usable([*every]), strict=True) if is_one}
    except NoAnswer as error:
        raise at.bad(f"can't be checked: {error}", "try apprise yourself: apprise --dry-run -b test URL") from None
    users = {user: tuple(_address(one, known) for one in some) for user, some in by_user.items()}
    urls = tuple(_address(one, known) for one in heard)
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
        # It may be a URL with a slip.
        raise at.bad("is neither a URL nor the name of a file", "write one, as in mailtos://user:password@example.org")
    return text


def _address(written: _Written, known: Container[str]) -> Address:
    url, at, line = written
    what = ""
    if len(url) > MAX_URL or not url.isprintable():
        what = "is too long, or not printable"
    elif url not in known:
        what = "is no URL that Apprise can use (not shown: it may hold a secret)"
    if what:
        raise at.bad(f"{line}{what}", "https://appriseit.com shows the form for each service")
    return Address(at.key or f"{at.source} {line}".strip(), url)
