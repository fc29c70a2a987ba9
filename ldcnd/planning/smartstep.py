"""What a SmartStep line promises: its items are read word by word, and the words of all its units take turns."""

from collections.abc import Mapping
from dataclasses import replace

from ldcnd.config.axis import AxisConfig
from ldcnd.config.bus import BusConfig
from ldcnd.drivers.smartstep.costs import BAUD, price_list, words_of
from ldcnd.drivers.smartstep.monitors import HISTORY_LENGTH
from ldcnd.drivers.smartstep.poller import Basic, Item
from ldcnd.drivers.smartstep.profiles import SMARTSTEP, SmartStepProfile
from ldcnd.planning.cost import Cost, LineTiming, cost_of
from ldcnd.planning.line_plan import Poll, Urgent

ALARM_HISTORY_HZ = HISTORY_LENGTH / 60
"""One word a turn: an alarm that came and went between two readings of the state is found within a minute."""


def rates_hz(axis: AxisConfig) -> Mapping[Item, float]:
    """Return what is read of a unit and how often."""
    rates = axis.rates
    wanted: dict[Item, float] = {
        Basic.STATE: rates.state,
        Basic.VELOCITY: rates.velocity or rates.state,  # whether it moves is part of the state
        Basic.POSITION: rates.position or rates.state / 10,
    }
    wanted[Basic.ALARM_HISTORY] = ALARM_HISTORY_HZ
    wanted.update(axis.smartstep.monitors.items())
    return wanted


def line_timing(bus: BusConfig) -> LineTiming:
    """Return how fast the line is; the silence before each command counts as the host's."""
    timing = LineTiming(BAUD, BAUD, adapter_latency_s=bus.adapter_latency_ms / 1000)
    return replace(timing, turnaround_s=max(timing.turnaround_s, SMARTSTEP.quiet_s))


def polls_of(bus: BusConfig, timing: LineTiming) -> list[Poll]:
    """Return every item of every unit with what all its words take together."""
    polls = []
    for axis in bus.axis:
        word = price_list(_planned(axis)).reading(frozenset())
        cost = cost_of(word, timing)
        for item, rate_hz in rates_hz(axis).items():
            if rate_hz > 0:
                words = words_of(item)
                polls.append(
                    Poll(
                        axis=axis.name,
                        items=(item.value,),
                        rate_hz=rate_hz,
                        cost=_times(words, cost),
                        mean_s=words * cost.longest_s,
                        request_bytes=words * len(word.request),
                        reply_bytes=words * word.reply_bytes,
                        exchanges=words,
                    )
                )
    return polls


def urgent_of(bus: BusConfig, timing: LineTiming) -> Urgent:
    """Return what goes before polls: the exchanges of commissioning and traces; nothing on this line stops a motor."""
    prices = [price_list(_planned(axis)) for axis in bus.axis]
    commands = [cost_of(exchange, timing) for price in prices for exchange in price.commands.values()]
    flush_s = len(prices[0].flush) * timing.bits_per_byte / timing.host_baud
    return Urgent(
        command_s=max(command.longest_s for command in commands),
        stop_s=0.0,
        recovery_s=flush_s + prices[0].settle_s,
        margin_s=bus.margin_ms / 1000,
    )


def _planned(axis: AxisConfig) -> SmartStepProfile:
    return replace(SMARTSTEP, first_character_s=axis.smartstep.planned_response_s)


def _times(words: int, cost: Cost) -> Cost:
    return Cost(
        request_s=words * cost.request_s,
        wait_s=words * cost.wait_s,
        reply_s=words * cost.reply_s,
        overhead_s=words * cost.overhead_s,
        ends_early=False,
    )
