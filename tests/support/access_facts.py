"""What a viewer and an operator may do, whatever tells them apart: each cell of docs/reference/security.md a test."""

import json
import time

import pytest
import zenoh

from ldcnd.contract.catalogue import COMMANDS
from ldcnd.contract.commands import About, Effect
from tests.support.secured_rig import SecuredRig, answers, refusals

LOGINS = ("viewer", "operator")
TELEMETRY = "ldcn/sim/tele/"
HEALTH = "ldcn/sim/meta/health"
FORGED = b'{"value": 4711}'


class AccessFacts:
    """For test classes that have a fixture `rig` with the logins `viewer` and `operator`."""

    @pytest.mark.parametrize("login", LOGINS)
    def test_connects(self, rig: SecuredRig, login: str) -> None:
        with rig.login(login) as session:
            routers = [*session.info.peers_zid(), *session.info.routers_zid()]

        assert len(routers) == 1

    @pytest.mark.parametrize("login", LOGINS)
    def test_subscribes_to_telemetry_and_health_and_sees_nothing_else(self, rig: SecuredRig, login: str) -> None:
        with rig.login(login) as session:
            received = session.declare_subscriber("**", zenoh.handlers.FifoChannel(200))
            keys = {str(received.recv().key_expr) for _ in range(30)}

        assert keys
        assert all(key.startswith((TELEMETRY, HEALTH)) for key in keys)

    @pytest.mark.parametrize("login", LOGINS)
    def test_gets_last_values_and_descriptions_and_nothing_else(self, rig: SecuredRig, login: str) -> None:
        with rig.login(login) as session:
            everything = answers(session, "**")

        assert {f"{TELEMETRY}{axis}/position" for axis in "xyzc"} <= set(everything)
        assert "ldcn/sim/meta/daemon" in everything
        assert all(key.startswith((TELEMETRY, "ldcn/sim/meta/")) for key in everything)

    @pytest.mark.parametrize("login", LOGINS)
    def test_sees_that_the_daemon_is_alive(self, rig: SecuredRig, login: str) -> None:
        with rig.login(login) as session:
            tokens = alive(session)

        assert len([token for token in tokens if "/axis/" not in token]) == 1

    @pytest.mark.parametrize("key", ["ldcn/sim/@cmd/y/power", "ldcn/*/@cmd/y/power", "ldcn/sim/@cmd/*/power"])
    def test_viewer_motion_query_is_empty_and_not_executed(self, rig: SecuredRig, key: str) -> None:
        with rig.login("viewer") as viewer:
            got = answers(viewer, key, {"on": True})
            refused = refusals(viewer, key, {"on": True})
            state = state_of(viewer, "y")

        assert (got, refused) == ({}, [])
        assert state["enabled"] is False

    @pytest.mark.parametrize("login", LOGINS)
    @pytest.mark.parametrize("verb", ["x/why", "_/events", "_/holders", "_/wire_log"])
    def test_questions_are_answered(self, rig: SecuredRig, login: str, verb: str) -> None:
        asked = {"bus": "line0"} if verb.endswith("wire_log") else {}
        with rig.login(login) as session:
            got = answers(session, f"ldcn/sim/@cmd/{verb}", asked)

        assert list(got) == [f"ldcn/sim/@cmd/{verb}"]

    def test_viewer_is_told_what_is_wrong_with_a_question(self, rig: SecuredRig) -> None:
        with rig.login("viewer") as viewer:
            refused = refusals(viewer, "ldcn/sim/@cmd/nothing/why", {})

        assert [json.loads(error)["code"] for error in refused] == ["unknown_axis"]

    @pytest.mark.parametrize(
        "verb",
        sorted(
            f"{'y' if each.about is About.AXIS else '_'}/{each.verb}"
            for each in COMMANDS
            if each.effect is not Effect.QUESTION
        ),
    )
    def test_nothing_else_of_a_viewer_is_executed_and_no_one_waits_for_that(self, rig: SecuredRig, verb: str) -> None:
        asked_s = time.monotonic()
        with rig.login("viewer") as viewer:
            got = answers(viewer, f"ldcn/sim/@cmd/{verb}", {})
            refused = refusals(viewer, f"ldcn/sim/@cmd/{verb}", {})

        assert (got, refused) == ({}, [])
        assert time.monotonic() < asked_s + 4

    @pytest.mark.parametrize(("login", "axis", "published"), [("viewer", "z", []), ("operator", "c", [500])])
    def test_what_an_observer_says_is_published_for_operators_only(
        self, rig: SecuredRig, login: str, axis: str, published: list[int]
    ) -> None:
        with rig.login(login) as observer:
            said = {"t": 1, "learning": False, "judged": 500}
            got = answers(observer, f"ldcn/sim/@cmd/{axis}/report_shadow", said)
            last = answers(observer, f"{TELEMETRY}{axis}/shadow")

        assert len(got) == len(published)
        assert [json.loads(each)["judged"] for each in last.values()] == published

    def test_operator_motion_query_is_executed(self, rig: SecuredRig) -> None:
        with rig.login("operator") as operator:
            answers(operator, "ldcn/sim/@cmd/x/reset", {})
            powered = answers(operator, "ldcn/sim/@cmd/x/power", {"on": True})
            moved = answers(operator, "ldcn/sim/@cmd/x/move_relative", {"distance": 0.5})

        assert len(powered) == 1
        assert json.loads(moved["ldcn/sim/@cmd/x/move_relative"])["status"] == "accepted"

    def test_operator_is_told_why_a_command_is_refused(self, rig: SecuredRig) -> None:
        with rig.login("operator") as operator:
            refused = refusals(operator, "ldcn/sim/@cmd/x/move_absolute", {"position": "far"})

        assert [json.loads(error)["code"] for error in refused] == ["malformed_request"]

    @pytest.mark.parametrize("login", LOGINS)
    def test_stop_is_carried_out(self, rig: SecuredRig, login: str) -> None:
        with rig.login(login) as session:
            stopped = answers(session, "ldcn/sim/@stop/c")
            state = state_of(session, "c")

        assert json.loads(stopped["ldcn/sim/@stop/c"])["confirmed"] == ["c"]
        assert state["stop_latched"] is True

    @pytest.mark.parametrize("login", LOGINS)
    def test_spoofed_put_reaches_nobody(self, rig: SecuredRig, login: str) -> None:
        key = f"{TELEMETRY}z/position"
        with rig.login(login) as forger, rig.login("operator") as watcher:
            received = watcher.declare_subscriber(key, zenoh.handlers.FifoChannel(200))
            received.recv()  # from now on everything arrives
            forger.put(key, FORGED)
            forger.delete(key)
            alive(forger)  # the daemon has seen what came before on this link
            last = answers(watcher, key)
            genuine = [received.recv() for _ in range(5)]

        assert json.loads(last[key])["value"] != 4711
        assert all(sample.kind == zenoh.SampleKind.PUT for sample in genuine)
        assert FORGED not in [sample.payload.to_bytes() for sample in genuine]

    @pytest.mark.parametrize("login", LOGINS)
    def test_hijacking_queryable_is_asked_nothing(self, rig: SecuredRig, login: str) -> None:
        hijacked: list[str] = []

        def hijack(query: zenoh.Query) -> None:
            hijacked.append(str(query.key_expr))
            query.reply(query.key_expr, FORGED)

        with rig.login(login) as thief, rig.login("operator") as operator:
            for key in ("ldcn/sim/@cmd/**", "ldcn/sim/@stop/**", "ldcn/sim/tele/**", "ldcn/sim/meta/**"):
                thief.declare_queryable(key, hijack, complete=True)
            alive(thief)  # the daemon has seen the declarations
            got = answers(operator, "ldcn/sim/@cmd/_/holders", {})
            got |= answers(operator, "ldcn/sim/@stop/c")
            got |= answers(operator, "ldcn/sim/tele/x/state")
            got |= answers(operator, "ldcn/sim/meta/daemon")

        assert len(got) == 4
        assert hijacked == []
        assert FORGED.decode() not in got.values()

    @pytest.mark.parametrize("login", LOGINS)
    def test_forged_daemon_token_is_seen_by_nobody(self, rig: SecuredRig, login: str) -> None:
        with rig.login(login) as forger, rig.login("operator") as operator:
            with forger.liveliness().declare_token("ldcn/sim/alive/rival"):
                answers(forger, "ldcn/sim/meta/budget")
                tokens = alive(operator)
                answers(operator, "ldcn/sim/@cmd/x/reset", {})
                # with a rival the daemon would move nothing
                powered = answers(operator, "ldcn/sim/@cmd/x/power", {"on": True})

        assert "ldcn/sim/alive/rival" not in tokens
        assert len(powered) == 1

    def test_client_token_is_not_shown_to_other_clients(self, rig: SecuredRig) -> None:
        with rig.login("operator") as operator, rig.login("viewer") as viewer:
            with operator.liveliness().declare_token("ldcn/sim/client/ada"):
                answers(operator, "ldcn/sim/meta/budget")
                seen = [str(reply.ok.key_expr) for reply in viewer.liveliness().get("ldcn/sim/client/*") if reply.ok]

        assert seen == []


def state_of(session: zenoh.Session, axis: str) -> dict[str, object]:
    """Return an axis's next state: one that was measured after this call."""
    asked_ns = time.time_ns()
    deadline_s = time.monotonic() + 5
    key = f"{TELEMETRY}{axis}/state"
    while time.monotonic() < deadline_s:
        state: dict[str, object] = json.loads(answers(session, key)[key])
        if isinstance(state["t"], int) and state["t"] > asked_ns:
            return state
        time.sleep(0.02)  # a state comes five times a second
    raise TimeoutError(f"{key} does not tick")


def alive(session: zenoh.Session) -> set[str]:
    """Return the tokens of daemons."""
    return {str(reply.ok.key_expr) for reply in session.liveliness().get("ldcn/sim/alive/**") if reply.ok}
