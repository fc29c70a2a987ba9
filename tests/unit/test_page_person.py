"""A person at a page: late and foreign answers answer nothing, and a button that was let go stays let go."""

import asyncio

import pytest

from ldcnd.bench.person import Left
from ldcnd.console.commissioning.conversation import Conversation
from ldcnd.console.commissioning.messages import FromCommissioningPage, HoldButton, PersonAnswer, View
from ldcnd.console.commissioning.page_person import HELD_S, PagePerson


@pytest.fixture
def person():
    return PagePerson(lambda: None)


async def asked(person):
    """Wait for a question."""
    while person.question is None:
        await asyncio.sleep(0)
    return person.question


async def test_only_an_answer_to_the_present_question_counts(person):
    async with asyncio.TaskGroup() as group:
        choice = group.create_task(person.choose("which", {"one": "the first", "other": "the second"}))
        question = await asked(person)
        person.answer(PersonAnswer(number=question.number - 1, text="one"))
        person.answer(PersonAnswer(number=question.number, text="neither"))
        person.hold(HoldButton(number=question.number, on=True))
        await asyncio.sleep(0)
        assert not choice.done()
        person.answer(PersonAnswer(number=question.number, text="other"))

    assert choice.result() == "other"


async def test_a_number_is_asked_for_until_it_is_one(person):
    async with asyncio.TaskGroup() as group:
        number = group.create_task(person.number("how far", 2.5))
        first = await asked(person)
        person.answer(PersonAnswer(number=first.number, text="far"))
        while person.question is None or person.question.number == first.number:
            await asyncio.sleep(0)
        person.answer(PersonAnswer(number=person.question.number, text=" 4 "))

    assert first.default == "2.5"
    assert number.result() == 4
    assert person.lines == ("'far' is no number: 0, or 1e-12 to 1e+12 either way",)


async def test_control_characters_of_drives_and_files_reach_no_page(person):
    person.tell("a\x1b[2Jb")

    assert person.lines == ("a\\x1b[2Jb",)


async def test_a_press_that_is_over_at_once_holds_nothing(person):
    async def held():
        with pytest.raises(Left):
            async with person.holding("it moves"):
                pytest.fail("nothing holds it")

    async with asyncio.TaskGroup() as group:
        group.create_task(held())
        first = (await asked(person)).number
        person.hold(HoldButton(number=first, on=True))
        person.hold(HoldButton(number=first, on=False))
        while person.question is None or person.question.number == first:
            await asyncio.sleep(0)
        assert not person.holds
        person.hold(HoldButton(number=first, on=True))  # a late message of the first button
        await asyncio.sleep(0)
        assert not person.holds
        person.leave()


async def test_a_page_that_goes_in_the_instant_of_its_press_holds_nothing(person):
    async def held():
        with pytest.raises(Left):
            async with person.holding("it moves"):
                pytest.fail("nothing holds it")

    async with asyncio.TaskGroup() as group:
        group.create_task(held())
        person.hold(HoldButton(number=(await asked(person)).number, on=True))
        person.leave()


@pytest.mark.parametrize("typed", ["1e308", "-1e13", "1e-13", "1e-320", "nan", "-inf"])
async def test_a_number_with_which_nothing_can_be_worked_out_is_none(person, typed):
    async with asyncio.TaskGroup() as group:
        number = group.create_task(person.number("how far"))
        first = (await asked(person)).number
        person.answer(PersonAnswer(number=first, text=typed))
        while person.question is None or person.question.number == first:
            await asyncio.sleep(0)
        person.answer(PersonAnswer(number=person.question.number, text="-2"))

    assert number.result() == -2
    assert "is no number" in person.lines[0]


class Steps(Conversation):
    """A page whose only step takes a while to come to its end."""

    def __init__(self):
        super().__init__()
        self.brought_to_its_end = False

    def shown(self):
        return View()

    async def refresh(self):
        pass

    def is_stale(self):
        return False

    async def carry_out(self, begun):
        try:
            await self.person.ask("go on")
        finally:
            await asyncio.sleep(1.0)
            self.brought_to_its_end = True


async def test_leaving_twice_does_not_cut_short_how_a_step_is_brought_to_its_end():
    page = Steps()
    running = asyncio.create_task(page.run())
    page.heard(FromCommissioningPage(begin="step"))
    await asked(page.person)
    page.heard(FromCommissioningPage(leave=True))
    await asyncio.sleep(0.5)
    page.heard(FromCommissioningPage(leave=True))
    await asyncio.sleep(1.0)
    running.cancel()

    assert page.brought_to_its_end


async def test_a_step_that_is_left_before_it_has_begun_does_not_begin():
    page = Steps()
    running = asyncio.create_task(page.run())
    page.heard(FromCommissioningPage(begin="step"))
    page.heard(FromCommissioningPage(leave=True))
    await asyncio.sleep(5.0)
    running.cancel()

    assert page.person.question is None
    assert (await page.view()).running == ""


async def test_silence_releases_the_button_for_good(person):
    loop = asyncio.get_running_loop()
    async with asyncio.TaskGroup() as group:
        begun = group.create_task(asked(person))
        await asyncio.sleep(0)

        async def press():
            question = await begun
            for _ in range(5):
                person.hold(HoldButton(number=question.number, on=True))
                await asyncio.sleep(0.1)
            return question.number, loop.time()

        pressing = group.create_task(press())
        async with person.holding("it moves") as released:
            await released.wait()
            number, last_s = await pressing
            person.hold(HoldButton(number=number, on=True))
            assert released.is_set()
            assert not person.holds

    assert loop.time() - last_s == pytest.approx(HELD_S - 0.1)


async def test_a_page_that_is_gone_is_asked_nothing(person):
    person.leave()

    with pytest.raises(Left):
        await person.ask("anything")
