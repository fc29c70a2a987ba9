"""What a page sends of what is pressed while other things have no answer yet: soon, or not at all."""

from typing import Any

import pytest

from tests.support.console_parts import ask_the_pages, part_of_pages

LONG_MS = 65_000
ASK_THE_PAGES = """
const [source, steps] = JSON.parse(require("fs").readFileSync(0, "utf8"));
let nowMs = 0;
let timers = [];
const [sent, answers, told] = [[], new Map(), {}];
Object.defineProperty(globalThis, "performance", { value: { now: () => nowMs } });
const turn = setImmediate;
globalThis.setTimeout = (act, ms) => timers.push({ act, atMs: nowMs + ms });
globalThis.document = { cookie: "" };
globalThis.location = { port: "" };
globalThis.fetch = (path) => {
  sent.push(path);
  return new Promise((resolve) => answers.set(path, () => resolve({ ok: true, status: 200, json: async () => ({}) })));
};
const passed = () => new Promise((resolve) => turn(resolve));
import(`data:text/javascript;base64,${Buffer.from(source).toString("base64")}`).then(async (pages) => {
  const { ask, press, Press, waitsFor } = pages;
  const ofAll = new Press();
  for (const [what, value, patienceMs] of steps) {
    const tell = (outcome) => { told[value] = outcome; };
    const refused = ({ message, remedy, refused }) => tell({ message, remedy, refused });
    if (what === "ask") ask(value, {}, patienceMs).then(() => tell("done"), refused);
    if (what === "press of all") press(value, {}, { pressed: ofAll }).then(() => tell("done"), refused);
    if (what === "press") press(value, {}, { patienceMs }).then(() => tell("done"), refused);
    if (what === "waits for") tell(waitsFor(value));
    if (what === "answer") answers.get(value)();
    if (what === "wait" || what === "wait out of sight") nowMs += value;
    if (what === "wait") {
      timers.filter(({ atMs }) => atMs <= nowMs).forEach(({ act }) => act());
      timers = timers.filter(({ atMs }) => atMs > nowMs);
    }
    await passed();
  }
  console.log(JSON.stringify([sent, told]));
});
"""
"""Carries out steps on a clock of its own; tells what went out, and what became of what was asked."""
LONG = [("ask", "all of spool", LONG_MS), ("ask", "all of feed", LONG_MS)]
SHORT = [("ask", "preview of x"), ("ask", "preview of y")]
NOT_SENT = {
    "message": "what was asked before has no answer yet; nothing was sent",
    "remedy": "press again",
    "refused": True,
}


def carried_out(*steps: tuple[object, ...]) -> tuple[list[str], dict[str, Any]]:
    sent, told = ask_the_pages(ASK_THE_PAGES, part_of_pages("api.js", "session"), steps)
    return sent, told


@pytest.mark.parametrize("questions", [LONG, SHORT], ids=["long", "short"])
def test_a_press_stands_behind_no_question(questions):
    sent, _ = carried_out(*questions, ("press", "move of x"))

    assert sent == [questions[0][1], "move of x"]


def test_a_press_goes_before_questions_that_wait():
    before = [("press", "home of y"), ("press", "home of z")]
    sent, _ = carried_out(*before, *SHORT, ("press", "move of x"), ("wait", 900), ("answer", "home of y"))

    assert sent == ["home of y", "home of z", "move of x"]


@pytest.mark.parametrize("how", ["wait", "wait out of sight"])
@pytest.mark.parametrize(
    ("before", "pressed"),
    [
        ([*LONG, *SHORT], ("press", "move of x")),
        ([("press", "home of y"), ("press", "home of z")], ("press", "move of x")),
        (LONG, ("press", "write to spool", LONG_MS)),
    ],
    ids=["questions", "presses", "long"],
)
def test_what_is_pressed_and_has_no_turn_in_time_is_never_sent(how, before, pressed):
    """The timers of a page that is not in sight are late."""
    under_way, _ = carried_out(*before)
    sent, told = carried_out(*before, pressed, (how, 1_100), *(("answer", each) for each in under_way))

    assert pressed[1] not in sent
    assert told[pressed[1]] == NOT_SENT


def test_what_is_pressed_for_many_axes_is_sent_for_as_long_as_one_follows_the_other():
    axes = [f"home of {number}" for number in range(6)]
    goes_on = [step for axis in axes[:3] for step in (("wait", 700), ("answer", axis))]
    sent, told = carried_out(*(("press of all", axis) for axis in axes), *goes_on, ("wait", 1_100))

    assert sent == axes[:5]
    assert told == dict.fromkeys(axes[:3], "done") | {axes[5]: NOT_SENT}


def test_a_question_waits_for_its_turn_however_long_it_takes():
    sent, told = carried_out(*LONG, ("wait", 60_000), ("answer", "all of spool"))

    assert sent == ["all of spool", "all of feed"]
    assert told == {"all of spool": "done"}


def on_spool(verb: str, axis: str = "spool") -> str:
    return f"/api/rigs/op/axes/{axis}/{verb}"


def test_what_waits_for_the_answer_of_a_silent_drive_names_it():
    long, short = ("ask", on_spool("read_all_parameters"), LONG_MS), ("ask", on_spool("read_alarms"))
    preview, move = on_spool("preview", "x"), on_spool("move_absolute", "x")
    waits = ("waits for", preview)
    sent, told = carried_out(long, short, ("ask", preview), waits, ("press", move), ("wait", 1_100))

    assert sent == [long[1], short[1]]
    assert told[preview] == ["spool"]
    assert told[move]["remedy"] == "press again once spool has answered"
    assert told[move]["message"] == f"axis x: {NOT_SENT['message']}"

    _, told = carried_out(long, short, ("ask", preview), ("answer", short[1]), waits)
    assert told[preview] == []
