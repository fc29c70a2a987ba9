"""The configuration on a page: begun with what `ldcnd scan` finds on a port, and read again by the daemon."""

import difflib
from pathlib import Path

from typing_extensions import override

from ldcnd.bench.begun import begun_with, scan_port, write
from ldcnd.bench.family import ScannedDrive
from ldcnd.bench.known import BENCHES, ports_here
from ldcnd.client.rig import Rig
from ldcnd.config.rig import load_config
from ldcnd.console.commissioning.conversation import Conversation
from ldcnd.console.commissioning.messages import FromCommissioningPage, View
from ldcnd.console.rigs import Rigs
from ldcnd.contract.errors import UnknownVerb
from ldcnd.contract.health import Finding

SCAN = "scan"
RELOAD = "reload"
TAKE = {"yes": "Reload", "no": "Leave"}
ANY = "any"
CONSENT = (
    "no drive has an address: reset the line and give addresses? That is done only where nothing can be moving; the"
    " motors lose their positions"
)


class ScanConversation(Conversation):
    """One page that looks for drives, on a port that no daemon has, or has the daemon read the configuration again.

    Args:
        rigs: of the console.
        config: the configuration that is begun, or added to.
    """

    def __init__(self, rigs: Rigs, config: Path) -> None:
        super().__init__()
        self._rigs = rigs
        self._config = config

    @override
    def shown(self) -> View:
        return View()

    @override
    async def refresh(self) -> None:
        """Nothing: all that it shows is what was said."""

    @override
    def is_stale(self) -> bool:
        return False

    @override
    async def carry_out(self, begun: FromCommissioningPage) -> None:
        if begun.begin == RELOAD:
            await self._reload()
            return
        if begun.begin != SCAN:
            raise UnknownVerb(f"there is no {begun.begin!r} here", value=begun.begin)
        person = self.person
        port = ""
        while not port:
            port = await person.pick("on which port", [each.port for each in ports_here()])
        families = {**{name: f"{name} drives" for name in BENCHES}, ANY: "not known: search for all of them"}
        wanted = await person.choose("which drives", families)
        names = list(BENCHES) if wanted == ANY else [wanted]
        for give_addresses in (False, True):
            if give_addresses and not await person.confirm(CONSENT):
                return
            for name in names:
                if drives := await self._found(name, port, give_addresses=give_addresses):
                    await self._offer(name, port, drives)
                    return
        person.tell("no drive was found: the lines above say what to check")

    async def _reload(self) -> None:
        """Show what a reload would change, and do it when the person agrees to that."""
        client = self._rigs.client(load_config(self._config).rig)
        rig = Rig(client, await client.daemon())
        shown = await rig.reload(dry_run=True)
        self.person.tell(*shown.lines())
        if any(each.taken for each in shown.changes) and await self.person.choose("reload", TAKE) == "yes":
            self.person.tell(*(await rig.reload(revision=shown.revision)).lines()[-1:])

    async def _found(self, name: str, port: str, *, give_addresses: bool) -> list[ScannedDrive]:
        self.person.tell(f"searching for {name} drives on {port}: 10 to 20 seconds")
        drives = await scan_port(BENCHES[name], port, self._show, give_addresses=give_addresses)
        return list(drives)

    def _show(self, finding: Finding) -> None:
        self.person.tell(f"{finding.axis} {finding.what}: {finding.text}")
        if finding.remedy:
            self.person.tell(f"    {finding.remedy}")

    async def _offer(self, name: str, port: str, drives: list[ScannedDrive]) -> None:
        """Show the configuration with these drives in it, and write it if the person agrees."""
        begun = begun_with(self._config, name, port, drives)
        self.person.tell(*begun.remarks[:-1])
        if begun.before == begun.text:
            self.person.tell(f"{self._config} has all of them")
            return
        file = str(self._config)
        before, after = begun.before.splitlines(), begun.text.splitlines()
        if await self.person.approve(file, list(difflib.unified_diff(before, after, file, file, lineterm="", n=2))):
            write(begun)
            self.person.tell(f"{file} is written: {len(drives)} drives. Start its daemon with the command on this page")
