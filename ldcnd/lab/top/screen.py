"""The screen: follows one rig, shows it a few times a second, and can stop it."""

import asyncio
from collections.abc import Sequence
from typing import ClassVar

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding
from textual.coordinate import Coordinate
from textual.widgets import DataTable, Footer, Static

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Halt, Reset
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.troubles import Severity
from ldcnd.lab.top.columns import AXIS_TITLES, BUS_TITLES, NARROW, axis_cells, headline, line_rows, narrow_cells
from ldcnd.lab.top.follow import follow
from ldcnd.lab.top.rig_view import RigView

REDRAW_S = 0.25
WIDE = 130
"""Columns of a terminal that has room for everything."""
NAME = "ldcnd top"
STYLES = {Severity.FINE: "", Severity.NOTICE: "yellow", Severity.WRONG: "bold red"}


class TopScreen(App[None]):
    """One rig.

    Args:
        client: of the rig; its session outlives the screen.
    """

    TITLE = "ldcnd"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[Binding | tuple[str, str] | tuple[str, str, str]]] = [
        Binding("s,escape", "stop_all", "STOP all (no emergency stop)", priority=True),
        Binding("h", "halt_axis", "Halt axis"),
        Binding("r", "reset_axis", "Reset axis"),
        Binding("q", "quit", "Quit"),
    ]
    CSS = """
    #headline { padding: 0 1; text-style: bold; }
    #answer { padding: 0 1; display: none; }
    #answer.said { display: block; }
    #axes { height: 1fr; }
    #buses { height: auto; max-height: 40%; border-top: solid $primary; }
    """

    def __init__(self, client: RigClient) -> None:
        super().__init__()
        self._client = client
        self._view = RigView(client.rig, asyncio.get_running_loop().time())
        self._shown: list[str] = []
        self._laid_out: tuple[int, ...] = ()

    def compose(self) -> ComposeResult:
        """Lay out the screen."""
        yield Static(id="headline", markup=False)
        yield Static(id="answer", markup=False)
        yield DataTable(id="axes", cursor_type="row", zebra_stripes=True)
        yield DataTable(id="buses", cursor_type="none")
        yield Footer()

    def on_mount(self) -> None:
        """Begin to follow the rig."""
        self.query_one("#buses", DataTable).add_columns(*BUS_TITLES)
        self.run_worker(follow(self._client, self._view), name="follow")
        self.set_interval(REDRAW_S, self._redraw)
        self._redraw()

    def action_stop_all(self) -> None:
        """Stop every axis; what became of it is shown above the tables."""
        self.run_worker(self._stop_all(), name="stop")

    def action_halt_axis(self) -> None:
        """Halt the axis under the cursor."""
        self.run_worker(self._send(Halt(client=NAME), "halted"), name="halt")

    def action_reset_axis(self) -> None:
        """Clear stop latch and faults of the axis under the cursor; nothing moves."""
        self.run_worker(self._send(Reset(client=NAME), "reset"), name="reset")

    def _chosen(self) -> str | None:
        """Return the axis under the cursor."""
        row = self.query_one("#axes", DataTable).cursor_row
        return self._shown[row] if row < len(self._shown) else None

    async def _send(self, command: Halt | Reset, done: str) -> None:
        axis = self._chosen()
        if axis is None:
            return
        try:
            await self._client.command(axis, command)
            self._say(f"{axis}: {done}")
        except LdcndError as error:
            self._say(f"{axis}: not {done}: {error.message}")

    async def _stop_all(self) -> None:
        self._say("stopping all axes ...")
        try:
            reply = await self._client.stop(client=NAME)
            said = (reply.shortfall.removesuffix("."), reply.outcome, reply.unreached.removesuffix("."), reply.warning)
            answer = ". ".join(filter(None, said))
        except LdcndError as error:
            answer = f"STOP NOT CONFIRMED: {error.message}. Use the machine's emergency stop."
        self._say(answer)

    def _columns(self) -> tuple[int, ...]:
        return NARROW if self.size.width < WIDE else tuple(range(len(AXIS_TITLES)))

    def _say(self, what: str) -> None:
        answer = self.query_one("#answer", Static)
        answer.update(what)
        answer.add_class("said")

    def _redraw(self) -> None:
        if not self.is_running:
            return  # the timer outlives the widgets while the screen closes
        glance = self._view.glance(asyncio.get_running_loop().time())
        urgent = glance.trouble or glance.count(Severity.WRONG)
        self.query_one("#headline", Static).update(Text(headline(glance), STYLES[Severity.WRONG] if urgent else ""))
        chosen, self._shown = self._chosen(), [row.axis for row in glance.axes]
        axes, columns = self.query_one("#axes", DataTable), self._columns()
        if columns != self._laid_out:
            axes.clear(columns=True)
            axes.add_columns(*(AXIS_TITLES[column] for column in columns))
            self._laid_out = columns
        cells = narrow_cells if columns == NARROW else axis_cells
        _fill(axes, [(cells(row), row.severity) for row in glance.axes])
        # the worst come first, so rows change: the cursor stays with the axis that a key is meant for
        if chosen in self._shown:
            axes.move_cursor(row=self._shown.index(chosen))
        _fill(self.query_one("#buses", DataTable), line_rows(glance))


def _fill(table: "DataTable[Text]", rows: Sequence[tuple[tuple[str, ...], Severity]]) -> None:
    """Put rows into a table; the scroll position stays where it is."""
    while table.row_count > len(rows):
        table.remove_row(table.ordered_rows[-1].key)
    while table.row_count < len(rows):
        table.add_row(*(Text() for _ in table.columns))
    for number, (cells, severity) in enumerate(rows):
        for column, cell in enumerate(cells):
            text, place = Text(cell, STYLES[severity]), Coordinate(number, column)
            before = table.get_cell_at(place)
            if (before.plain, before.style) != (text.plain, text.style):
                table.update_cell_at(place, text, update_width=True)
