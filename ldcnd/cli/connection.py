"""How commands find a running daemon: Zenoh's usual flags, a session, a rig."""

import asyncio
import json
import os
import shlex
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial, wraps
from pathlib import Path
from typing import NoReturn, TypeVar

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem
from pydantic import ValidationError

from ldcnd.certificate import watch_certificate
from ldcnd.cli.interrupts import run
from ldcnd.cli.names import OPTIONS_TYPED
from ldcnd.cli.output import leaves_of, show_lines
from ldcnd.cli.typed import CONFIGURATION
from ldcnd.client.lease import inherited_lease
from ldcnd.client.presence import tell_absence
from ldcnd.client.rig_client import RigClient, find_rig, no_rig_answers, on_each_rig
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.frozen import Frozen
from ldcnd.net.session import Session
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import DEFAULT_ENDPOINT, ZenohSettings, reached_at, user_settings
from ldcnd.systemd import Beside

CONFIG_HELP = "Zenoh configuration file to start from; or the daemon's own configuration, a .toml."
COMPLETION_S = 2.0
"""Longest time that a shell waits for the names of axes."""
ResultT = TypeVar("ResultT")
ModelT = TypeVar("ModelT", bound=Frozen)
CommandT = TypeVar("CommandT", bound=Callable[..., object])


def of_options(model: type[ModelT], **values: object) -> ModelT:
    """Return a model of what was typed; an option that was not typed is left to the model.

    Raises:
        click.BadParameter: a value is none that the model takes, such as nan; names the option.
    """
    try:
        return model.model_validate({name: value for name, value in values.items() if value is not None})
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        name = ".".join(map(str, wrong["loc"])) or "value"
        given, bounds = wrong["input"], wrong.get("ctx", {})
        if isinstance(given, tuple | list):
            bound = f"at least {bounds['min_length']}" if "min_length" in bounds else f"at most {bounds['max_length']}"
            text = f"takes {bound}, and {len(given)} came"
        else:
            text = f"{wrong['msg'][:1].lower()}{wrong['msg'][1:]}, not {given!r}"
        raise click.BadParameter(text, param_hint=name.replace("_", "-")) from None


class AxisName(click.types.StringParamType):
    """The name of an axis; the shell completes it with those of the daemon that the command line names.

    Args:
        session_option: the option of the command that names a Zenoh configuration file.
    """

    def __init__(self, session_option: str = "config") -> None:
        self.session_option = session_option

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002
        """Return the axes that begin so; none when no daemon answers in time."""
        given = {name: ctx.params.get(name) for name in ("connect", "listen", self.session_option, "rig")}
        connect = given["connect"] or tuple(filter(None, [os.environ.get("LDCND_CONNECT")]))

        async def names(client: RigClient) -> list[str]:
            async with asyncio.timeout(COMPLETION_S):
                return [info.axis for info in await client.axes()]

        try:
            found = Target.given(
                connect, given["listen"] or (), given[self.session_option], given["rig"], as_json=False
            ).run(names)
        except (LdcndError, TimeoutError):
            return []
        return [CompletionItem(name) for name in found if name.startswith(incomplete)]


AXIS = AxisName()


class TargetOption(click.Option):
    """An option that `with_target` gives to a command; the reference explains them once."""


def _say(problem: str | None) -> None:
    show_lines(problem or "a daemon is heard again", err=True)


def _remark(remark: str | None) -> None:
    if remark:
        show_lines(remark, err=True)


@asynccontextmanager
async def _certificate_watched(session: Session, remark: Callable[[str | None], None]) -> AsyncIterator[None]:
    """Say what is the matter with the certificate of a session, for as long as the context lasts."""
    watching = asyncio.create_task(watch_certificate(session.certificate, remark), name="end of the certificate")
    try:
        yield
    finally:
        watching.cancel()


class Serving:
    """What a program that serves others says of itself: to its service manager, and in its journal or terminal."""

    def __init__(self) -> None:
        self._beside = Beside()

    def serves(self, what: str, *, err: bool = False) -> None:
        """Say what it serves now; on standard error where the output is for something else."""
        show_lines(what, err=err)
        self._beside.serves(what)

    def lacks(self, problem: str | None) -> None:
        """Say what is missing, or None once nothing is."""
        _say(problem)
        self._beside.lacks(problem)

    def remarks(self, remark: str | None) -> None:
        """Say what is to be seen to though nothing is missing, or None once that is done."""
        _remark(remark)
        self._beside.remarks(remark)

    @contextmanager
    def last_words(self) -> Iterator[None]:
        """Leave behind what has ended the program: its journal has that from who prints the error."""
        try:
            yield
        except BaseException as error:
            for leaf in leaves_of(error):
                if isinstance(leaf, LdcndError | OSError | click.ClickException):
                    self._beside.lacks(getattr(leaf, "message", str(leaf)))
            raise


@dataclass(frozen=True, slots=True)
class Target:
    """The session's connection to the daemon.

    Attributes:
        connect: endpoints to connect to.
        listen: endpoints to listen on.
        config: a Zenoh configuration file to start from.
        rig: which rig; None when only one can be reached.
        as_json: print JSON lines instead of text.
    """

    connect: tuple[str, ...]
    listen: tuple[str, ...]
    config: Path | None
    rig: str | None
    as_json: bool

    @classmethod
    def given(
        cls, connect: tuple[str, ...], listen: tuple[str, ...], config: Path | None, rig: str | None, *, as_json: bool
    ) -> "Target":
        """Return the target of what was typed; a daemon's configuration names its endpoint and its rig.

        What it prints to be typed names this target, too: without its options that would reach another rig.

        Raises:
            ConfigError: the configuration cannot be read.
        """
        OPTIONS_TYPED.set(_options_typed(connect, listen, config, rig))
        if config and config.suffix == ".toml":
            from ldcnd.config.rig import load_config  # noqa: PLC0415 - most commands do without

            daemon = load_config(config)
            return cls(connect or (reached_at(daemon.zenoh.listen),), listen, None, rig or daemon.rig, as_json)
        return cls(connect, listen, config, rig, as_json)

    def run(
        self, work: Callable[[RigClient], Awaitable[ResultT]], remark: Callable[[str | None], None] = _remark
    ) -> ResultT:
        """Open a session, find the rig, do the work, and close."""

        async def within() -> ResultT:
            async with open_rig(self._settings(), self.rig) as client, _certificate_watched(client.session, remark):
                client.watch_rivals(lambda: click.echo(client.rivals, err=True))
                return await work(client)

        return run(within)

    def follow(
        self,
        work: Callable[[RigClient], Awaitable[None]],
        say: Callable[[str | None], None] = _say,
        remark: Callable[[str | None], None] = _remark,
    ) -> None:
        """Do the same for a command that goes on until it is ended; it says when no daemon is heard any more."""

        async def watch(client: RigClient) -> None:
            with suppress(LdcndError):
                await tell_absence(client.session, self._settings(), say, (client.rig,))

        async def within(client: RigClient) -> None:
            watching = asyncio.create_task(watch(client), name="presence of the daemon")
            try:
                await work(client)
            finally:
                watching.cancel()

        self.run(within, remark)

    def serve(self, work: Callable[[RigClient, Serving], Awaitable[None]]) -> None:
        """Do the same for a program that serves others until it is ended; it says when it does, and what it lacks."""
        service = Serving()
        with service.last_words():
            self.follow(lambda client: work(client, service), service.lacks, service.remarks)

    def run_on_each(self, work: Callable[[RigClient], Awaitable[ResultT]]) -> dict[str, ResultT | LdcndError]:
        """Do the same with the rig that is named, unsearched, or with every one that can be reached.

        For what takes energy out: it asks no question first.

        Raises:
            SessionError: no rig can be reached.
        """
        named = self.rig

        async def within(session: Session) -> dict[str, ResultT | LdcndError]:
            if named is None:
                return await on_each_rig(session, work)
            try:
                return {named: await work(RigClient(session, named))}
            except LdcndError as error:
                return {named: error}

        return self.run_session(within) or self._unreached()

    def _unreached(self) -> NoReturn:
        raise no_rig_answers(self._settings().connect)

    def run_session(self, work: Callable[[Session], Awaitable[ResultT]]) -> ResultT:
        """Open a session, do the work with it, and close; no rig needs to be there."""

        async def within() -> ResultT:
            async with open_zenoh_session(self._settings()) as session, _certificate_watched(session, _remark):
                return await work(session)

        return run(within)

    def show(self, model: Frozen, *lines: str, **about: str | None) -> None:
        """Print one result: as a line of JSON, with what it is about in front, or as these lines."""
        if self.as_json:
            lines = (json.dumps({**about, **json.loads(model.model_dump_json())}, separators=(",", ":")),)
        show_lines(*lines)

    def _settings(self) -> ZenohSettings:
        return user_settings(self.connect, self.listen, self.config)


def _target_options(command: CommandT) -> CommandT:
    """Give a command the options that make a `Target`."""
    option = partial(click.option, cls=TargetOption)
    for given in (
        option("--json", "as_json", is_flag=True, help="Print JSON lines."),
        option("--rig", help="Which rig, when several can be reached."),
        option("--config", type=CONFIGURATION, help=CONFIG_HELP),
        option("--listen", "-l", multiple=True, help="Zenoh endpoint to listen on; may be repeated."),
        option(
            "--connect",
            "-e",
            multiple=True,
            envvar="LDCND_CONNECT",
            help=f"Zenoh endpoint of the daemon, or HOST:PORT [$LDCND_CONNECT, or {DEFAULT_ENDPOINT}].",
        ),
    ):
        command = given(command)
    return command


def with_target(work: Callable[..., None]) -> Callable[..., None]:
    """Give a command its options for finding the daemon, as one `Target` in front of its own arguments."""

    @_target_options
    @wraps(work)
    def command(**options: object) -> None:
        # click has converted the five options to the types of the fields
        target = Target.given(**{name: options.pop(name) for name in Target.__slots__})  # type: ignore[arg-type]
        work(target, **options)

    return command


def _options_typed(connect: tuple[str, ...], listen: tuple[str, ...], config: Path | None, rig: str | None) -> str:
    """Return the options that name daemon and rig, as every command takes them; the environment reaches all of them."""
    context = click.get_current_context(silent=True)
    if context and context.get_parameter_source("connect") is ParameterSource.ENVIRONMENT:
        connect = ()
    given = (
        *(("-e", each) for each in connect),
        *(("-l", each) for each in listen),
        *([("--config", str(config))] if config else []),
        *([("--rig", rig)] if rig else []),
    )
    return "".join(f" {option} {shlex.quote(each)}" for option, each in given)


@asynccontextmanager
async def open_rig(settings: ZenohSettings, rig: str | None = None) -> AsyncIterator[RigClient]:
    """Join the network and use one rig for as long as the context lasts.

    Args:
        settings: where to connect, and with which login.
        rig: which one; not needed when only one can be reached.

    Raises:
        SessionError: no connection, or no daemon answers.
        UnknownAxis: several rigs can be reached and none was named.
    """
    async with open_zenoh_session(settings) as session:
        found = await find_rig(session, rig, settings.connect)
        # what is sent under $LDCND_LEASE is so for every command, whatever it sends
        yield RigClient(session, found.rig, inherited_lease())
