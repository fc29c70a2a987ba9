"""Metrics of a whole daemon."""

import asyncio
import re
import signal
from asyncio.subprocess import PIPE

import pytest
from prometheus_client import CollectorRegistry

from ldcnd.client.overview import health_reports
from ldcnd.lab.metrics import HealthCollector
from ldcnd.version import version
from tests.support.process import LDCND, ROOT, daemon
from tests.support.rig import running_rig


async def test_a_daemon_s_reports_become_metrics():
    async with running_rig() as rig:
        registry = CollectorRegistry()
        collector = HealthCollector("sim", asyncio.get_running_loop().time)
        registry.register(collector)

        async with health_reports(rig.client, collector.take):
            await asyncio.sleep(3.5)

        assert registry.get_sample_value("ldcnd_daemon_up", {"rig": "sim"}) == 1
        assert registry.get_sample_value("ldcnd_build_info", {"rig": "sim", "version": version()}) == 1
        assert registry.get_sample_value("ldcnd_daemon_info", {"rig": "sim", "version": version()}) == 1
        rate = registry.get_sample_value("ldcnd_axis_rate_hertz", {"rig": "sim", "bus": "line0", "axis": "x"})
        wanted = registry.get_sample_value("ldcnd_axis_rate_wanted_hertz", {"rig": "sim", "bus": "line0", "axis": "x"})
        assert rate == pytest.approx(wanted, rel=0.05)


@pytest.mark.real_time
@pytest.mark.timeout(120)
@pytest.mark.long
async def test_metrics_are_served_over_http_by_a_process_of_their_own():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        metrics = ("metrics", "-e", endpoint, "--address", "127.0.0.1:0")
        serving = await asyncio.create_subprocess_exec(*LDCND, *metrics, stdout=PIPE)
        assert serving.stdout
        async with asyncio.timeout(45):
            told = (await serving.stdout.readline()).decode()
            port = int(re.search(r":(\d+)/metrics", told)[1])
            page = ""
            while 'ldcnd_bus_up{bus="line0",rig="sim"} 1.0' not in page:
                await asyncio.sleep(0.2)
                page = await fetch(port)
            serving.send_signal(signal.SIGTERM)
            code = await serving.wait()

    assert 'ldcnd_daemon_up{rig="sim"} 1.0' in page
    assert code == 0


async def fetch(port: int) -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(b"GET /metrics HTTP/1.0\r\n\r\n")
    page = await reader.read()
    writer.close()
    await writer.wait_closed()
    return page.decode()
