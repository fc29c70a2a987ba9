"""Keys: their spelling, their parsers, and that expressions match as Zenoh's do."""

import pytest
import zenoh
from hypothesis import assume, given
from hypothesis import strategies as st

from ldcnd.contract.errors import MalformedRequest, ValueOutOfRange, WildcardRefused
from ldcnd.contract.keys import RIG_ITSELF, AliveAddress, CommandAddress, Keys, TelemetryAddress, matches

KEYS = Keys("bench1")

chunks = st.from_regex(r"[a-z0-9_]{1,8}", fullmatch=True)
expression_chunks = st.one_of(
    st.sampled_from(["*", "**", "a", "b", "ab", "@cmd", "@a", "a$*", "$*b", "a$*b", "$*a$*"]),
    st.text("ab", min_size=1, max_size=3),
)


def canonical(chunks: list[str]) -> str | None:
    """Return the expression in Zenoh's canonical form, or None when it is none at all."""
    try:
        return str(zenoh.KeyExpr.autocanonize("/".join(chunks)))
    except zenoh.ZError:
        return None


def test_every_key_is_spelled_as_documented() -> None:
    spelled = {
        KEYS.telemetry("x", "position"): "ldcn/bench1/tele/x/position",
        KEYS.daemon: "ldcn/bench1/meta/daemon",
        KEYS.axis("x"): "ldcn/bench1/meta/axes/x",
        KEYS.commands: "ldcn/bench1/meta/commands",
        KEYS.schema("state_sample"): "ldcn/bench1/meta/schema/state_sample",
        KEYS.alive("i1"): "ldcn/bench1/alive/i1",
        KEYS.alive_axis("i1", "x"): "ldcn/bench1/alive/i1/axis/x",
        KEYS.client("c1"): "ldcn/bench1/client/c1",
        KEYS.command("x", "move_absolute"): "ldcn/bench1/@cmd/x/move_absolute",
        KEYS.command(RIG_ITSELF, "acquire"): "ldcn/bench1/@cmd/_/acquire",
        KEYS.stop(): "ldcn/bench1/@stop",
        KEYS.stop("x"): "ldcn/bench1/@stop/x",
        KEYS.all_commands: "ldcn/bench1/@cmd/**",
        KEYS.all_telemetry: "ldcn/bench1/tele/**",
        KEYS.all_meta: "ldcn/bench1/meta/**",
    }

    for key, text in spelled.items():
        assert key == text
        assert zenoh.KeyExpr(key)


def test_patterns_cover_their_keys_and_no_others() -> None:
    assert matches(KEYS.all_telemetry, KEYS.telemetry("x", "state"))
    assert matches(KEYS.all_meta, KEYS.axis("x"))
    assert matches(KEYS.all_commands, KEYS.command("x", "halt"))
    assert matches(KEYS.all_alive, KEYS.alive("i1"))
    assert matches(KEYS.all_alive, KEYS.alive_axis("i1", "x"))
    assert not matches(KEYS.all_telemetry, KEYS.daemon)
    assert not matches(KEYS.all_commands, Keys("bench2").command("x", "halt"))


def test_each_stop_key_is_covered_by_exactly_one_stop_pattern() -> None:
    for key in (KEYS.stop(), KEYS.stop("x")):
        assert [matches(pattern, key) for pattern in KEYS.all_stops] == [True]


@pytest.mark.parametrize("wide", ["**", "*/**", "ldcn/**", "ldcn/bench1/**", "ldcn/bench1/*/x/halt", "ldcn/bench1/$*"])
def test_no_wildcard_reaches_a_command_or_a_stop(wide: str) -> None:
    assert not matches(wide, KEYS.command("x", "halt"))
    assert not matches(wide, KEYS.all_commands)
    assert not matches(wide, KEYS.stop())
    assert not matches(wide, KEYS.stop("x"))


@given(chunks, chunks)
@pytest.mark.long
def test_keys_and_their_parsers_are_inverse(axis: str, word: str) -> None:
    assert KEYS.parse_command(KEYS.command(axis, word)) == CommandAddress(axis, word)
    assert KEYS.parse_telemetry(KEYS.telemetry(axis, word)) == TelemetryAddress(axis, word)
    assert KEYS.parse_stop(KEYS.stop(axis)) == axis
    assert KEYS.parse_alive(KEYS.alive(word)) == AliveAddress(word, None)
    assert KEYS.parse_alive(KEYS.alive_axis(word, axis)) == AliveAddress(word, axis)


def test_the_stop_of_the_rig_names_no_axis() -> None:
    assert KEYS.parse_stop("ldcn/bench1/@stop") is None


@pytest.mark.parametrize("rest", ["*", "**", "x/y", "X", "a$*", "x/"])
def test_a_stop_that_names_no_single_axis_stops_the_rig(rest: str) -> None:
    assert KEYS.parse_stop(f"ldcn/bench1/@stop/{rest}") is None


def test_a_stop_with_a_wildcard_before_its_axis_still_names_it() -> None:
    assert KEYS.parse_stop("ldcn/*/@stop/x") == "x"
    assert KEYS.parse_stop("**/@stop") is None


@pytest.mark.parametrize("key", ["ldcn/bench2/@stop", "ldcn/bench1/stop", "ldcn/bench1/@cmd/x/stop", ""])
def test_foreign_keys_are_no_stops(key: str) -> None:
    with pytest.raises(MalformedRequest):
        KEYS.parse_stop(key)


@pytest.mark.parametrize("key", ["ldcn/bench1/@cmd/*/halt", "ldcn/*/@cmd/x/halt", "ldcn/bench1/@cmd/**", "a$*"])
def test_a_command_with_a_wildcard_is_refused_as_such(key: str) -> None:
    with pytest.raises(WildcardRefused, match="exactly one axis"):
        KEYS.parse_command(key)


@pytest.mark.parametrize(
    "key",
    [
        "ldcn/bench1/@cmd/x",
        "ldcn/bench1/@cmd/x/halt/now",
        "ldcn/bench1/@cmd/X/halt",
        "ldcn/bench2/@cmd/x/halt",
        "",
        "/",
    ],
)
def test_a_key_that_is_no_command_is_malformed_and_says_the_form(key: str) -> None:
    with pytest.raises(MalformedRequest, match="@cmd/<axis>/<verb>"):
        KEYS.parse_command(key)


@pytest.mark.parametrize("name", ["", "X", "a-b", "a/b", "*", "@x", "ä", "a b", "x\n"])
def test_a_name_that_is_no_chunk_is_refused(name: str) -> None:
    with pytest.raises(ValueOutOfRange, match="cannot stand in a key"):
        KEYS.telemetry(name, "position")
    with pytest.raises(ValueOutOfRange, match="rig"):
        Keys(name)


@given(st.lists(expression_chunks, min_size=1, max_size=6), st.lists(expression_chunks, min_size=1, max_size=6))
def test_expressions_match_as_zenoh_says(left_chunks: list[str], right_chunks: list[str]) -> None:
    left, right = canonical(left_chunks), canonical(right_chunks)
    assume(left is not None)
    assume(right is not None)

    ours = matches(left, right)

    assert ours == zenoh.KeyExpr(left).intersects(zenoh.KeyExpr(right))
    assert ours == matches(right, left)
