"""`ldcnd schema`: what is generated from models, keys, configuration and commands."""

from pathlib import Path

import click

from ldcnd.cli.manual import as_markdown as as_reference
from ldcnd.cli.manual import man_pages
from ldcnd.cli.verb_methods import verb_methods, with_blocking_methods
from ldcnd.config.reference import config_reference
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.errors import as_markdown as errors_as_markdown
from ldcnd.daemon.asyncapi import asyncapi_text
from ldcnd.daemon.contract import all_schemas, as_markdown


@click.group()
def command() -> None:
    """Write or check the JSON Schemas of the public models."""


@command.command()
@click.argument("folder", type=click.Path(path_type=Path), default=Path("schemas"))
def write(folder: Path) -> None:
    """Write all schemas into FOLDER, removing those of models that are gone."""
    folder.mkdir(exist_ok=True)
    schemas = all_schemas()
    for name, text in schemas.items():
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
    for path in folder.glob("*.json"):
        if path.stem not in schemas:
            path.unlink()
    click.echo(f"{len(schemas)} schemas in {folder}")


@command.command()
@click.argument("folder", type=click.Path(path_type=Path), default=Path("schemas"))
def check(folder: Path) -> None:
    """Fail when FOLDER differs from what the models say."""
    schemas = all_schemas()
    on_disk = {path.stem: path.read_text(encoding="utf-8") for path in folder.glob("*.json")}
    differing = sorted(name for name in schemas.keys() | on_disk.keys() if schemas.get(name) != on_disk.get(name))
    if differing:
        raise ConfigError(f"{folder} differs from the models in: {', '.join(differing)}; run `ldcnd schema write`")
    click.echo(f"{len(schemas)} schemas in {folder} are up to date")


@command.command()
@click.argument("page", type=click.Path(path_type=Path), default=Path("docs/reference/configuration.md"))
def configuration(page: Path) -> None:
    """Write the reference of the configuration file to PAGE."""
    page.write_text(config_reference(), encoding="utf-8")
    click.echo(str(page))


@command.command("cli")
@click.argument("page", type=click.Path(path_type=Path), default=Path("docs/reference/cli.md"))
def command_line(page: Path) -> None:
    """Write the reference of the command line to PAGE."""
    page.write_text(as_reference(), encoding="utf-8")
    click.echo(str(page))


@command.command()
@click.argument("folder", type=click.Path(path_type=Path))
def man(folder: Path) -> None:
    """Write the man pages into FOLDER."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = man_pages()
    for name, text in pages.items():
        (folder / name).write_text(text, encoding="utf-8")
    click.echo(f"{len(pages)} man pages in {folder}")


@command.command()
def asyncapi() -> None:
    """Print the interface as an AsyncAPI 3 document (JSON)."""
    click.echo(asyncapi_text(), nl=False)


@command.command()
@click.argument("page", type=click.Path(path_type=Path, exists=True, dir_okay=False), required=False)
def keys(page: Path | None) -> None:
    """Print all keys as a Markdown table, or renew the table at the end of PAGE (docs/reference/keys.md)."""
    _print_or_renew(as_markdown(), page)


@command.command("client")
@click.argument("folder", type=click.Path(path_type=Path), default=Path("ldcnd/client"))
def client_methods(folder: Path) -> None:
    """Write the methods of the Python client into the modules in FOLDER; `make fix` formats them."""
    (folder / "verbs.py").write_text(verb_methods(), encoding="utf-8")
    blocking = folder / "blocking.py"
    blocking.write_text(with_blocking_methods(blocking.read_text(encoding="utf-8")), encoding="utf-8")
    click.echo(str(folder))


@command.command("python")
@click.argument("page", type=click.Path(path_type=Path), default=Path("docs/reference/python.md"))
def python_client(page: Path) -> None:
    """Write the reference of the Python client to PAGE."""
    # not above: the client's methods can be regenerated also when those that there are cannot be loaded
    from ldcnd.cli.client_reference import client_reference  # noqa: PLC0415

    page.write_text(client_reference(), encoding="utf-8")
    click.echo(str(page))


@command.command("errors")
@click.argument("page", type=click.Path(path_type=Path, exists=True, dir_okay=False), required=False)
def error_codes(page: Path | None) -> None:
    """Print all error codes as a Markdown table, or renew the table at the end of PAGE (docs/reference/errors.md)."""
    _print_or_renew(errors_as_markdown(), page)


def _print_or_renew(table: str, page: Path | None) -> None:
    if page is None:
        click.echo(table, nl=False)
        return
    before, found, _ = page.read_text(encoding="utf-8").partition(table.partition("\n")[0])
    if not found:
        raise ConfigError(f"{page}: has no such table")
    page.write_text(before + table, encoding="utf-8")
