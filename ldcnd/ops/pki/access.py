"""Access rules: what a viewer and an operator may do, in the words of Zenoh's access control.

Everything is denied that no rule allows. Readers may query `**`, because it covers neither `@cmd` nor `@stop`; the
rules for the way out decide what they get. Only the daemon may publish, answer, or show a token of a daemon.
The rules see the neighbour on a link, not the origin of a message: behind a router they see the router.

Source: Zenoh 1.10.2, configuration `access_control`; a rule counts only when its key expression includes the message's.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from ldcnd.contract.catalogue import COMMANDS
from ldcnd.contract.commands import About, Role
from ldcnd.contract.keys import ALL_CLIENTS, ALL_COMMANDS, ALL_READABLE, ALL_STOPS, RIG_ITSELF, ROOT


class Flow(StrEnum):
    """Which way a message goes, seen from the daemon."""

    INGRESS = "ingress"
    EGRESS = "egress"


class Subject(StrEnum):
    """By what a login is known, in Zenoh's words."""

    CERTIFICATES = "cert_common_names"
    USERS = "usernames"
    LINKS = "link_protocols"


@dataclass(frozen=True, slots=True)
class Rule:
    """One permission."""

    name: str
    flow: Flow
    messages: tuple[str, ...]
    keys: tuple[str, ...]


ASKING = ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber")
TELLING = ("put", "delete", "reply", "liveliness_token", "declare_queryable")
ANSWERING = ("reply", "declare_queryable")

WATCH = (
    Rule("watch_in", Flow.INGRESS, ASKING, ("**",)),
    Rule("watch_out", Flow.EGRESS, TELLING, ALL_READABLE),
)
STOP = (
    Rule("stop_in", Flow.INGRESS, ("query",), (ALL_STOPS,)),
    Rule("stop_out", Flow.EGRESS, ANSWERING, (ALL_STOPS,)),
)
COMMAND = (
    Rule("command_in", Flow.INGRESS, ("query",), (ALL_COMMANDS,)),
    Rule("command_out", Flow.EGRESS, ANSWERING, (ALL_COMMANDS,)),
)
QUESTIONS = tuple(
    f"{ROOT}/*/@cmd/{'*' if each.about is About.AXIS else RIG_ITSELF}/{each.verb}"
    for each in COMMANDS
    if each.role() is Role.VIEWER
)
"""Keys of what changes nothing."""
ASK = (
    Rule("ask_in", Flow.INGRESS, ("query",), QUESTIONS),
    Rule("ask_out", Flow.EGRESS, ("reply",), QUESTIONS),
    # the daemon has one queryable for all commands, and this is how a viewer's questions find it
    Rule("ask_whom", Flow.EGRESS, ("declare_queryable",), (ALL_COMMANDS,)),
)
PRESENCE = (
    Rule("presence_in", Flow.INGRESS, ("liveliness_token",), (ALL_CLIENTS,)),
    Rule("presence_out", Flow.EGRESS, ("declare_liveliness_subscriber", "liveliness_query"), (ALL_CLIENTS,)),
)

EVERYTHING = (*ASKING, *TELLING)
EVERYWHERE = ("**", ALL_COMMANDS, ALL_STOPS)
CARRY = (
    Rule("carry_in", Flow.INGRESS, EVERYTHING, EVERYWHERE),
    Rule("carry_out", Flow.EGRESS, EVERYTHING, EVERYWHERE),
)

RULES = (*WATCH, *STOP, *ASK, *COMMAND, *PRESENCE)
PERMITTED: Mapping[Role, tuple[Rule, ...]] = {
    Role.VIEWER: (*WATCH, *STOP, *ASK),
    Role.OPERATOR: (*WATCH, *STOP, *COMMAND, *PRESENCE),
}
"""At a daemon that people connect to."""
PERMITTED_BEHIND_ROUTER: Mapping[Role, tuple[Rule, ...]] = {**PERMITTED, Role.ROUTER: CARRY}
"""At a daemon that routers connect to as well: they have checked the client."""
PERMITTED_AT_ROUTER: Mapping[Role, tuple[Rule, ...]] = {
    **PERMITTED_BEHIND_ROUTER,
    Role.DAEMON: CARRY,
}
"""At a router. The rig of a daemon is not checked."""


def access_control(
    subject: Subject,
    logins: Mapping[Role, tuple[str, ...]],
    permitted: Mapping[Role, tuple[Rule, ...]] = PERMITTED,
) -> dict[str, object]:
    """Return the value of Zenoh's `access_control`: each login may do what its role permits, and nothing else.

    Args:
        subject: by what logins are known.
        logins: who has which role. A role without logins is left out, because Zenoh refuses an empty list.
        permitted: what each role permits.
    """
    present = {role: names for role in permitted if (names := logins.get(role, ()))}
    rules = dict.fromkeys(rule for role in (*PERMITTED, *present) for rule in permitted[role])
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": rule.name,
                "permission": "allow",
                "flows": [rule.flow.value],
                "messages": list(rule.messages),
                "key_exprs": list(rule.keys),
            }
            for rule in rules
        ],
        "subjects": [{"id": f"{role}s", subject.value: list(names)} for role, names in present.items()],
        "policies": [{"rules": [rule.name for rule in permitted[role]], "subjects": [f"{role}s"]} for role in present],
    }
