"""What a real node shows to a real Prometheus, which is asked in its own language."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import subprocess
import urllib.parse
import urllib.request
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.hang import HANG
from tests.live.bench import comes_to, granted
from tests.live.lab import Lab, awaited
from tests.live.rights import Present
from tests.ports import free_port
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import CommandRefused, RequestRefused

pytestmark = pytest.mark.live

PROJECT = Path(__file__).parents[2]
CONFIG = PROJECT / "deploy" / "prometheus" / "prometheus.yml"
PROMETHEUS = shutil.which("prometheus")
without = pytest.mark.skipif(PROMETHEUS is None, reason="prometheus is missing: install the package prometheus")


def get(url: str) -> str:
    with urllib.request.urlopen(url, timeout=HANG) as answer:  # noqa: S310 - on loopback
        return str(answer.read().decode())


async def shown(lab: Lab, host: str) -> str:
    """What a node shows now."""
    await lab.logged(host, "metrics at http")
    url = re.findall(r"metrics at (\S+)", lab.log(host))[-1]
    return await asyncio.to_thread(get, url)


class PrometheusServer:
    """Debian's Prometheus with the example of `deploy/`, in a hurry."""

    def __init__(self, folder: Path, target: int) -> None:
        text, found = re.subn(r"127\.0\.0\.1:9464", f"127.0.0.1:{target}", CONFIG.read_text().split("global:")[1])
        assert found == 1
        text = "global:" + text.replace("scrape_interval: 15s", "scrape_interval: 1s").replace("5s", "1s")
        (folder / "prometheus.yml").write_text(text)
        self.url = f"http://127.0.0.1:{free_port()}"
        with (folder / "prometheus.log").open("wb") as log:
            self._process = subprocess.Popen(
                [
                    str(PROMETHEUS),
                    f"--config.file={folder / 'prometheus.yml'}",
                    f"--storage.tsdb.path={folder / 'data'}",
                    f"--web.listen-address={self.url.removeprefix('http://')}",
                ],
                stdout=log,
                stderr=log,
            )

    async def ask(self, query: str) -> list[dict[str, Any]]:
        """The result of a query; empty until there is one."""
        url = f"{self.url}/api/v1/query?{urllib.parse.urlencode({'query': query})}"
        try:
            answer = json.loads(await asyncio.to_thread(get, url))
        except OSError:
            return []
        assert answer["status"] == "success", answer
        found: list[dict[str, Any]] = answer["data"]["result"]
        return found

    async def until(self, query: str, labels: dict[str, str], least: float) -> float:
        """Waits until the query has such a result, of at least so much."""

        async def found() -> list[float]:
            results = [one for one in await self.ask(query) if labels.items() <= one["metric"].items()]
            return [float(one["value"][1]) for one in results if float(one["value"][1]) >= least]

        return (await awaited(found, bool))[0]

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()


@asynccontextmanager
async def measured(folder: Path) -> AsyncIterator[tuple[Lab, Client, int]]:
    """A node that leads, has a robot and shows its figures, with a client and what it has done."""
    groups = "" if Present.secured else '[roles]\nclient = ["test"]\n[groups]\npeople = ["test"]\n'
    async with Lab(folder, extra=groups) as lab:
        port = free_port()
        lab.node("anvil", "robot/a", extra=f"[metrics]\nport = {port}")
        client = await lab.begun("worker")
        first, second = [
            await client.request(name, {"robot/a": {}}, min_runtime=60, estimate=True) for name in ("first", "second")
        ]
        while second.start is None:
            await client.changed(second)
        grant = await granted(client, first, confirmed=True)
        await client.command("robot/a", grant, {"name": "echo", "value": 1})
        await client.end(first)
        with pytest.raises(CommandRefused):
            await client.command("robot/a", grant, {"name": "echo", "value": 2})
        assert await client.granted(second, confirmed=True) is not None
        urgent = await client.request("urgent", {"robot/a": {}}, priority=5, min_runtime=60)
        assert await client.granted(urgent, confirmed=True) is not None
        await comes_to(second, "queued")  # what it is told of its own may come after that
        await client.end(urgent)
        assert await client.granted(second, confirmed=True) is not None
        await client.end(second)
        with pytest.raises(RequestRefused):
            await client.request("strange", {"robot/a": {"speed": 1}})
        yield lab, client, port


async def test_a_node_shows_what_it_knows(tmp_path: Path) -> None:
    async with measured(tmp_path) as (lab, _, _):
        text = await shown(lab, "anvil")
    for line in (
        r'zscout_info\{fleet="test-\w+",host="anvil",version="[\d.]+"\} 1\.0',
        r"zscout_links [1-9]\.0",
        r"zscout_leading 1\.0",
        r"zscout_terms_led_total 1\.0",
        r"zscout_queue_length 0\.0",
        r'zscout_wait_seconds_count\{group="people",priority="0"\} 3\.0',
        r'zscout_wait_seconds_count\{group="people",priority="5"\} 1\.0',
        # It was foretold to start when the first one's minimum runtime would be over.
        r'zscout_forecast_error_seconds_bucket\{le="-15\.0"\} [1-9]\.0',
        r'zscout_preemptions_total\{group="people",priority="0"\} 1\.0',
        r'zscout_refusals_total\{code="unknown_parameter"\} 1\.0',
        r'zscout_holds\{rc="robot/a"\} 0\.0',
        r'zscout_held_seconds_total\{rc="robot/a"\} [\d.e-]+',
        r'zscout_commands_total\{rc="robot/a"\} 1\.0',
        r'zscout_commands_refused_total\{code="\w+",rc="robot/a"\} 1\.0',
    ):
        assert re.search(f"^{line}$", text, re.MULTILINE), f"{line}\n{text}"


@pytest.mark.slow
@without
async def test_prometheus_scrapes_it_and_answers_from_that(tmp_path: Path) -> None:
    async with measured(tmp_path) as (_, client, port):
        prometheus = PrometheusServer(tmp_path, port)
        try:
            rc, leads = {"rc": "robot/a"}, {"host": "anvil"}
            await client.granted(await client.request("third", {"robot/a": {}}, min_runtime=600))
            assert await prometheus.until("zscout_holds", rc, 1) == 1
            # It grows while it is held.
            await prometheus.until("sum by (rc) (zscout_held_seconds_total)", rc, 3)
            await prometheus.until("sum by (rc) (rate(zscout_held_seconds_total[1m]))", rc, 0.01)
            waits = 'zscout_wait_seconds_count{group="people"}'
            assert await prometheus.until(waits, {"priority": "0"}, 4) == 4
            dashboard = "(zscout_leading == 1) * on(instance) group_left(host, fleet) zscout_info"
            assert await prometheus.until(dashboard, leads, 1) == 1
            (up,) = await prometheus.ask('up{job="zscout"}')
            assert up["value"][1] == "1"
        finally:
            prometheus.stop()


@without
async def test_prometheus_understands_all_that_the_dashboard_asks(tmp_path: Path) -> None:
    from tests.docs.test_metrics_reference import DASHBOARD, expressions

    asked = [one for one in expressions(json.loads(DASHBOARD.read_text())) if "zscout_" in one or "process_" in one]
    asked = [
        one.replace("$__rate_interval", "1m").replace("$fleet", ".*") for one in asked if "label_values" not in one
    ]
    assert len(asked) > 10
    prometheus = PrometheusServer(tmp_path, 1)
    try:
        await prometheus.until("vector(1)", {}, 1)
        for query in asked:
            assert await prometheus.ask(query) == []
    finally:
        prometheus.stop()


async def test_a_port_that_is_taken_ends_the_node_with_a_line(lab: Lab) -> None:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        one.listen()
        port = one.getsockname()[1]
        node = lab.node("anvil", extra=f"[metrics]\nport = {port}")
        assert await asyncio.to_thread(node.wait, HANG) == 1
    assert f"zscout-node: [metrics] can't be served at 127.0.0.1:{port}: " in lab.log("anvil")
