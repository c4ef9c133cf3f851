"""The notifier and a real receiver: what arrives, what is tried again, and what is logged where nothing does."""

from __future__ import annotations

import asyncio
import logging
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.services.notify.receiver import Receiver
from tests.services.notify.test_notices import ADA, of, report
from zscout.config import apprise_process
from zscout.config.notify import NotifyTable, read_notify
from zscout.config.strict import BadInput, Where
from zscout.messages import LoadReport
from zscout.services.notify.notices import Notification
from zscout.services.notify.notifier import QUEUE, Notifier
from zscout.types import SECOND

pytestmark = [pytest.mark.live, pytest.mark.real_time]

WHERE = Where("anvil.toml", ("notify",))
NEWS = Notification("preempted", "ada", "a title", "a body")


def notifier(table: NotifyTable, reports: Callable[[], Iterable[LoadReport]] = list, **how: float) -> Notifier:
    return Notifier("lab", read_notify(table, Path(), WHERE), reports, pauses=(0.0, 0.0), **how)


def started(made: Notifier) -> Notifier:
    made.start()
    return made


@pytest.mark.slow
async def test_it_arrives_as_text_at_the_urls_and_at_the_user_concerned() -> None:
    with Receiver() as lab, Receiver() as ada, Receiver() as bob:
        table = NotifyTable((lab.url,), ("yours_now",), {"ada": (ada.url,), "bob": (bob.url,)}, after=SECOND)
        telling = started(notifier(table))
        telling.notify(NEWS)  # of what the lab's URL does not hear
        telling.holds.on_began(of(ADA, 100))
        await asyncio.to_thread(lab.until, lambda: len(lab.heard) == 1)
        await asyncio.to_thread(ada.until, lambda: len(ada.heard) == 2)
        telling.stop()
        assert lab.titles == ["zscout lab: survey is yours now"]
        assert ada.titles == ["a title", *lab.titles]
        assert lab.heard[0]["message"] == "survey (ada@ws1) holds robot/a after a wait of 1 min 40 s"
        assert bob.heard == []
    # A node does without the 28 MB of all the services that Apprise knows.
    assert "apprise" not in sys.modules


@pytest.mark.slow
async def test_apprise_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    telling = notifier(NotifyTable(("json://localhost",)))
    monkeypatch.setattr(apprise_process, "TIMEOUT", 0.001)
    telling.notify(NEWS)
    telling.start()
    await asyncio.to_thread(telling._waiting.join)
    telling.stop()
    assert [record.getMessage() for record in caplog.records] == [
        "notify.urls[0] was not notified in 3 attempts: Apprise did not end within 0.001 s"
    ]
    with pytest.raises(BadInput, match=r"notify: can't be checked: Apprise did not end within 0\.001 s; try "):
        notifier(NotifyTable(("json://localhost",)))


@pytest.mark.slow
async def test_what_is_refused_is_tried_again() -> None:
    with Receiver(refuses=2) as lab:
        telling = started(notifier(NotifyTable((lab.url,))))
        telling.notify(NEWS)
        await asyncio.to_thread(lab.until, lambda: len(lab.heard) == 1)
        telling.stop()
        assert lab.asked == 3


@pytest.mark.slow
async def test_who_can_not_be_reached_is_logged_once_without_its_url_and_holds_up_nobody(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    with Receiver(refuses=1_000) as broken, Receiver() as lab:
        telling = started(notifier(NotifyTable((broken.url, lab.url), per_minute=600)))
        for number in range(2):
            telling.notify(NEWS._replace(title=f"{number}"))
        await asyncio.to_thread(lab.until, lambda: len(lab.heard) == 2)
        telling.stop()
        # Once it has failed it is left alone for a while.
        assert broken.asked == 3
    lines = [record.getMessage() for record in caplog.records if record.name.startswith("zscout")]
    assert lines == [
        "notify.urls[0] was not notified in 3 attempts: the service refused it",
        "notify.urls[0] can't be reached: dropped a notification",
    ]
    assert Receiver.SECRET not in caplog.text


@pytest.mark.slow
async def test_what_is_too_much_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    with Receiver() as lab:
        # It has not begun to send.
        telling = notifier(NotifyTable((lab.url,), per_minute=1))
        for _ in range(QUEUE + 5):
            telling.notify(NEWS)
        telling.start()
        await asyncio.to_thread(lab.until, lambda: len(lab.heard) == 1)
        await asyncio.to_thread(telling._waiting.join)
        telling.stop()
        assert len(lab.heard) == 1
    assert [record.getMessage() for record in caplog.records] == [
        f"{QUEUE} notifications are waiting: dropped another",
        "notify.urls[0]: more than 1 a minute; dropping the rest",
    ]


async def test_certificates_are_looked_at_while_this_node_leads() -> None:
    with Receiver() as lab:
        reports: list[LoadReport] = []
        telling = started(notifier(NotifyTable((lab.url,)), lambda: reports, look=0.01))
        reports.append(report("anvil", 86_400, renew=True))
        await asyncio.to_thread(lab.until, lambda: len(lab.heard) == 1)
        telling.stop()
        assert lab.titles == ["zscout lab: the certificate of anvil expires in 1.0 days"]


def test_a_url_is_in_no_repr() -> None:
    config = read_notify(NotifyTable((f"json://a:{Receiver.SECRET}@localhost",)), Path(), WHERE)
    assert Receiver.SECRET not in repr(config)
    assert config.urls[0].url.endswith("@localhost")


def test_urls_may_stand_in_a_file_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "lab.urls").write_text("# of the lab\n\njson://localhost/a\njsons://localhost/b\n")
    config = read_notify(NotifyTable(("lab.urls", "json://localhost/c")), tmp_path, WHERE)
    assert [one.url for one in config.urls] == ["json://localhost/a", "jsons://localhost/b", "json://localhost/c"]
    assert [one.at for one in config.urls] == [
        f"{tmp_path / 'lab.urls'} line 3",
        f"{tmp_path / 'lab.urls'} line 4",
        "notify.urls[1]",
    ]
    with pytest.raises(
        BadInput, match=r"no\.urls: there is no such file; .* \(named by anvil.toml: notify.urls\[1\]\)$"
    ):
        read_notify(NotifyTable(("lab.urls", "no.urls")), tmp_path, WHERE)


@pytest.mark.parametrize(("table", "package"), [("metrics", "prometheus-client"), ("notify", "apprise")])
def test_a_node_without_the_package_says_so_in_a_line(tmp_path: Path, table: str, package: str) -> None:
    urls = 'urls = ["json://localhost"]' if table == "notify" else ""
    (tmp_path / "anvil.toml").write_text(f"[{table}]\n{urls}\n")
    module = package.replace("-", "_")
    hidden = (
        "import sys, importlib.util as u\nfind = u.find_spec\n"
        f"u.find_spec = lambda name, *more: None if name == {module!r} else find(name, *more)\n"
        f"sys.modules[{module!r}] = None\nimport runpy\nsys.argv = ['zscout-node', 'anvil.toml']\n"
        "runpy.run_module('zscout.node', run_name='__main__')\n"
    )
    command = [sys.executable, "-c", hidden]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=HANG, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(f"zscout-node: anvil.toml: {table}: needs {package}, which is not installed here; ")
    assert len(done.stderr.splitlines()) == 1
