"""An axis as a motor record: what each put passes, and puts that move nothing by themselves, such as speeds."""

from caproto import AlarmSeverity, AlarmStatus, SubscriptionType

from ldcnd.contract.errors import LdcndError, ValueOutOfRange, WrongState
from ldcnd.contract.meta import AxisInfo
from ldcnd.lab.epics.fields import Action, Put, RecordAlarm, Value
from ldcnd.lab.epics.record import NO_LIMIT, Defaults, MotorRecord

REFUSED = RecordAlarm(AlarmStatus.STATE, AlarmSeverity.MINOR_ALARM)


class SettableRecord(MotorRecord):
    """A record that can be put to; see `MotorRecord`."""

    def __init__(self, info: AxisInfo, defaults: Defaults | None) -> None:
        super().__init__(info, defaults)
        self._pending = 0  # motions that were put and have not ended
        self._puts = 0
        self._taken = 0  # the newest put of a motion that was taken: a refusal of one before it says nothing more
        self._said = 0  # the newest put whose refusal was shown: only one after it that is taken ends that
        self._refused = False  # the motion that was put last: an alarm until the next put that is taken

    def alarm(self) -> RecordAlarm:
        """Return the alarm of the record: a motion that was refused is one, as clients look for it when DMOV is 1."""
        alarm = super().alarm()
        return max(alarm, REFUSED, key=lambda each: each.severity) if self._refused else alarm

    async def _show_refusal(self) -> None:
        """Show a motion that was refused as one that has ended with an alarm: many clients wait for DMOV alone."""
        if self._refused:
            return
        self._refused = True
        await self.show_alarm()
        self._pending += 1
        await self.show_motion()
        self._pending -= 1
        await self.show_motion()

    async def _show_taken(self) -> None:
        if self._refused:
            self._refused = False
            await self.show_alarm()
            await self.show_motion()

    def _explained(self, action: Action, *, is_always: bool, is_motion: bool) -> Action:
        """Show why a put was refused beside the record: Channel Access says only that it was."""

        async def explained(asked: Value) -> Put:
            self._puts = number = self._puts + 1
            try:
                if not is_always and self["DISP"].value:
                    raise WrongState(
                        f"axis {self.info.axis}: puts are disabled", axis=self.info.axis, remedy="put 0 to DISP"
                    )
                put = await action(asked)
            except (LdcndError, ValueError) as error:
                if not is_motion or number > self._taken:
                    self._said = max(self._said, number)
                    await self.show_beside(":message", str(error))
                    if is_motion:
                        await self._show_refusal()
                raise
            if is_motion:
                self._taken = max(self._taken, number)
            if number > self._said:
                await self.show_beside(":message", "")
                await self._show_taken()
            return put

        return explained

    async def _put_disp(self, asked: Value) -> Put:
        """Refuse puts from now on, or no more; what takes energy out is never refused."""
        await self.show_beside("_able", "Disable" if asked else "Enable")
        return Put(int(bool(asked)))

    async def _put_able(self, asked: Value) -> Put:
        await self["DISP"].show(int(asked == "Disable"))
        return Put(asked)

    async def _put_set(self, to: str, asked: Value) -> Put:
        if asked:
            await self["SET"].show(to)
        return Put(0)

    async def _put_deadband(self, event: SubscriptionType, asked: Value) -> Put:
        deadband = max(0.0, float(asked))
        self._thin(event, deadband)
        return Put(deadband)

    async def _put_velo(self, asked: Value) -> Put:
        velocity, highest = float(asked), self.info.limits.velocity or NO_LIMIT
        if velocity > highest:
            raise ValueOutOfRange(
                f"axis {self.info.axis}: {velocity:.12g} {self.info.unit}/s is above its limit",
                axis=self.info.axis,
                value=velocity,
                limit=highest,
            )
        return await self._put_positive(asked)

    async def _put_positive(self, asked: Value) -> Put:
        if not 0 < float(asked) < NO_LIMIT:
            raise ValueOutOfRange(
                f"axis {self.info.axis}: {float(asked):.12g} is not above 0", axis=self.info.axis, value=float(asked)
            )
        return Put(asked)

    async def _put_with(self, action: Action, asked: Value, approach: str, turns: tuple[str, ...]) -> Put:
        """Take a put for a field, for that of the approach, and for those that are in steps."""
        put = await action(asked)
        await self[approach].show(asked)
        for field in turns:
            await self[field].show(float(asked) / self._step)
        return put

    @staticmethod
    async def _keep(asked: Value) -> Put:
        return Put(asked)
