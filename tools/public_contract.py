"""What is public, as sorted lines, and which difference of two such lists breaks a program.

A line is a promise (`+`), which may be added and not taken away, or a demand (`-`), which may be taken away or widened
and not added where its subject was there before. `make fix` writes those of an unreleased version to `tests/kept`.
"""

import inspect
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import click

import ldcnd
from ldcnd.cli.main import cli
from ldcnd.cli.output import EXIT_CODES
from ldcnd.config.rig import RigConfig
from ldcnd.contract.frozen import schema_name
from ldcnd.contract.meta import API
from ldcnd.lab.metrics import HealthCollector
from tools.channels import channels
from tools.schemas import all_schemas

BOUNDS: Final = {
    "minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<", "minLength": "length >=",
    "maxLength": "length <=", "minItems": "items >=", "maxItems": "items <=", "pattern": "matches",
}  # fmt: skip
"""Keywords of JSON Schema that narrow a value, and how a line names them."""
UNRELEASED = "not yet released"
"""In the heading of a version in the changelog until it is released."""
_BOUND = re.compile(r"(?P<what>- .+: (?:items |length )?(?P<way>[<>])=?) (?P<limit>-?\d\S*)")
_HEADING = re.compile(r"(?m)^## (\S+)(.*)$")


def facts() -> tuple[str, ...]:
    """Return the contract of this working tree."""
    found = {*_network(), *_command_line(), *_python(), *_metrics()}
    return tuple(sorted(found, key=lambda line: (line[2:], line[0])))


def breaking(before: tuple[str, ...], now: tuple[str, ...]) -> tuple[str, ...]:
    """Return what a program that was written against `before` may miss or not expect."""
    gone = [line for line in before if line[0] == "+" and line not in set(now)]
    subjects = {_subject(line) for line in before}
    added = [line for line in now if line[0] == "-" and line not in set(before) and _known(_subject(line), subjects)]
    return (*gone, *(line for line in added if not _is_wider(line, before)))


def _is_wider(demand: str, before: tuple[str, ...]) -> bool:
    """Tell whether a demand only takes the place of a narrower one: what met that meets it, too."""
    bound = _BOUND.fullmatch(demand)
    if bound is None:
        return False
    found = (_BOUND.fullmatch(line) for line in before)
    earlier = [float(each["limit"]) for each in found if each and each["what"] == bound["what"]]
    limit = float(bound["limit"])
    return bool(earlier) and (limit >= max(earlier) if bound["way"] == "<" else limit <= min(earlier))


def unannounced(changes: tuple[str, ...], announcement: str) -> tuple[str, ...]:
    """Return the changes whose subject an announcement does not name in back quotes."""
    named = set(re.findall(r"`([^`]+)`", announcement))
    return tuple(change for change in changes if not any(_within(_subject(change), name) for name in named))


def changes_of(changelog: str, kept: str) -> str:
    """Return what a changelog says above the heading of a version that is kept."""
    heading = next((found for found in _HEADING.finditer(changelog) if found[1] == kept), None)
    if heading is None:
        raise ValueError(f"the changelog has no version {kept}")
    return changelog[: heading.start()]


def keep(folder: Path, changelog: str) -> None:
    """Write the contract of a version that is not yet released."""
    newest = _HEADING.search(changelog)
    if newest and UNRELEASED in newest[2]:
        (folder / newest[1]).mkdir(parents=True, exist_ok=True)
        (folder / newest[1] / "contract.txt").write_text("\n".join(facts()) + "\n", encoding="utf-8")


def _subject(line: str) -> str:
    return line[2:].partition(": ")[0]


def _known(subject: str, subjects: set[str]) -> bool:
    """Tell whether a demand meets programs of before: its subject was there, or it is a new need of what was there."""
    return subject in subjects or (subject.endswith(" needs") and subject.removesuffix(" needs") in subjects)


def _within(subject: str, name: str) -> bool:
    """Tell whether a name in an announcement stands for a subject: the subject or what it is a part of."""
    plain = subject.partition(" ")[2].removesuffix(" needs")
    return plain == name or plain.startswith((f"{name}.", f"{name} ", f"{name}/"))


def _network() -> Iterator[str]:
    yield f"+ network api: {API}"
    taken, sent = {schema_name(RigConfig)}, set[str]()
    for channel in channels():
        carried = schema_name(channel.taken) if channel.taken else "nothing"
        sent.add(schema_name(channel.sent))
        taken.update({carried} - {"nothing"})
        yield f"+ key {channel.key}: {channel.kind} takes {carried} sends {schema_name(channel.sent)}"
    sent = (sent | all_schemas().keys()) - taken
    for name, text in all_schemas().items():
        schema = json.loads(text)
        if name in taken:
            yield from _fields(f"payload {name}", schema, schema, "taken", ())
        if name in sent:
            yield from _fields(f"payload {name}", schema, schema, "sent", ())


def _fields(
    path: str, schema: Mapping[str, Any], whole: Mapping[str, Any], way: str, above: tuple[str, ...]
) -> Iterator[str]:
    """Yield what holds for a value: a reader's promises are its writer's demands, and the reverse."""
    if reference := schema.get("$ref", "").removeprefix("#/$defs/"):
        if reference not in above:
            yield from _fields(path, whole["$defs"][reference], whole, way, (*above, reference))
        return
    for variant in (*schema.get("anyOf", ()), *schema.get("oneOf", ()), *schema.get("prefixItems", ())):
        yield from _fields(path, variant, whole, way, above)
    kinds = schema.get("type", ())
    values = schema.get("enum") or ([schema["const"]] if "const" in schema else ())
    for kind in (kinds,) if isinstance(kinds, str) else kinds:
        yield f"{'+' if way == 'taken' else '-'} {path}: {way} {kind}"
    if way == "taken":
        yield from (f"+ {path}: takes {value!r}" for value in values)
        yield from (f"- {path}: {sign} {schema[word]}" for word, sign in BOUNDS.items() if word in schema)
    properties = schema.get("properties", {})
    mark = next((f"<{name}={value['const']}>" for name, value in properties.items() if "const" in value), "")
    for name, value in properties.items():
        yield f"+ {path}{mark}.{name}: {way}"
        yield from _fields(f"{path}{mark}.{name}", value, whole, way, above)
    for name in schema.get("required", ()):
        yield f"- {path} needs: {name}" if way == "taken" else f"+ {path}{mark}.{name}: always sent"
    for inner in (schema.get("items"), schema.get("additionalProperties")):
        if isinstance(inner, dict):
            yield from _fields(f"{path}[]", inner, whole, way, above)


def _command_line() -> Iterator[str]:
    yield from (f"+ exit {code}: {meaning}" for code, meaning in EXIT_CODES.items())
    yield from _commands("ldcnd", cli, click.Context(cli, info_name="ldcnd"))


def _commands(path: str, command: click.Command, context: click.Context) -> Iterator[str]:
    yield f"+ command {path}: there"
    for parameter in command.params:
        names = parameter.opts + parameter.secondary_opts if isinstance(parameter, click.Option) else [""]
        for name in names:
            subject = f"{path} {name}" if name else path
            yield f"+ command {subject}: {'option' if name else f'argument {parameter.human_readable_name}'}"
            choices = parameter.type.choices if isinstance(parameter.type, click.Choice) else ()
            yield from (f"+ command {subject}: takes {choice}" for choice in choices)
        if parameter.required:
            yield f"- command {path} needs: {parameter.opts[0] if names[0] else parameter.human_readable_name}"
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            if inner := command.get_command(context, name):
                yield from _commands(f"{path} {name}", inner, click.Context(inner, parent=context, info_name=name))


def _python() -> Iterator[str]:
    for name in dir(ldcnd):
        value = getattr(ldcnd, name)
        yield f"+ python ldcnd.{name}: there"
        if not isinstance(value, type):
            yield from _call(f"ldcnd.{name}", value)
            continue
        members = {own: member for base in reversed(_own_bases(value)) for own, member in vars(base).items()}
        for own, member in members.items():
            if own.startswith(("_", "model_")):
                continue
            yield f"+ python ldcnd.{name}.{own}: there"
            if inspect.isfunction(member):
                yield from _call(f"ldcnd.{name}.{own}", member)


def _own_bases(value: type) -> list[type]:
    return [base for base in value.__mro__ if base.__module__.startswith("ldcnd")]


def _call(path: str, call: Any) -> Iterator[str]:  # noqa: ANN401 - a function of any signature
    for parameter in inspect.signature(call).parameters.values():
        if parameter.name == "self":
            continue
        yield f"+ python {path}: takes {parameter.name}"
        variadic = parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        if parameter.default is parameter.empty and not variadic:
            yield f"- python {path} needs: {parameter.name}"


def _metrics() -> Iterator[str]:
    for metric in HealthCollector("any", lambda: 0.0).collect():
        labels = " ".join(getattr(metric, "_labelnames", ()))
        yield f"+ metric {metric.name}: {metric.type} by {labels}"
