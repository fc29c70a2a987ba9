"""Plant of a drive's position loop, in the quantities that a trace shows: counts, seconds, PWM steps.

An encoder cannot distinguish voltage, winding and torque constant. It shows the acceleration by one step of the output,
and the losses.
"""

import math
from dataclasses import dataclass

from ldcnd.sim.plant import MotorPlant

FULL_PWM = 255
ENDLESS_COUNTS = 1 << 40
_COUNTS_PER_REV = 2000
_SUPPLY_V = 24.0
LEAST_DAMPING_PER_S = 1e-3


@dataclass(frozen=True, slots=True)
class Plant:
    """Motor, load, amplifier and encoder of one axis.

    Attributes:
        acceleration: counts/s^2 per PWM step (1/255 of full output), above 0; inversely proportional to the inertia.
        damping_per_s: share of the speed that is lost per second with the amplifier on: viscous friction and the
            motor's back EMF, above 0.
        friction_pwm: Coulomb friction, in PWM steps that overcome it.
        load_pwm: a hanging load, in PWM steps of the same torque; positive when it pulls forward.
        delay_s: dead time between the output and the torque.
        backlash_counts: lost motion between motor and encoder.
    """

    acceleration: float
    damping_per_s: float
    friction_pwm: float = 0.0
    load_pwm: float = 0.0
    delay_s: float = 0.0
    backlash_counts: float = 0.0

    def motor(self) -> MotorPlant:
        """Return a simulated machine that behaves so while its amplifier is on; its winding has 1 ohm."""
        counts_per_rad = _COUNTS_PER_REV / math.tau
        ratio = self.acceleration * FULL_PWM / (_SUPPLY_V * counts_per_rad)  # torque constant over inertia
        inertia = max(self.damping_per_s, LEAST_DAMPING_PER_S) / ratio**2
        nm_per_pwm = self.acceleration / counts_per_rad * inertia
        return MotorPlant(
            counts_per_rev=_COUNTS_PER_REV,
            supply_v=_SUPPLY_V,
            resistance_ohm=1.0,
            torque_nm_per_a=ratio * inertia,
            inertia_kg_m2=inertia,
            viscous_nm_s=0.0,
            friction_nm=self.friction_pwm * nm_per_pwm,
            load_nm=self.load_pwm * nm_per_pwm,
            delay_s=self.delay_s,
            backlash_counts=self.backlash_counts,
            reverse_limit_counts=-ENDLESS_COUNTS,
            forward_limit_counts=ENDLESS_COUNTS,
        )

    @classmethod
    def of(cls, motor: MotorPlant) -> "Plant":
        """Return the plant that an encoder sees of a simulated machine."""
        counts_per_rad = motor.counts_per_rev / math.tau
        torque = motor.torque_nm_per_a
        nm_per_pwm = torque * motor.supply_v / motor.resistance_ohm / FULL_PWM
        return cls(
            acceleration=nm_per_pwm / motor.inertia_kg_m2 * counts_per_rad,
            damping_per_s=(torque * torque / motor.resistance_ohm + motor.viscous_nm_s) / motor.inertia_kg_m2,
            friction_pwm=motor.friction_nm / nm_per_pwm,
            load_pwm=motor.load_nm / nm_per_pwm,
            delay_s=motor.delay_s,
            backlash_counts=motor.backlash_counts,
        )
