"""Substeps of the simulated axis: the drive's loops, the mechanics, and the sampling of the encoders.

`hdbridge.sim.axis` calls `Loops` once per control cycle. All inputs and outputs are numbers, so the class can
be compiled as a whole.
"""

from hdbridge.sim.encoder import Body, Disc, Late
from hdbridge.sim.loaded_plant import LoadedPlant
from hdbridge.sim.plant import Plant
from hdbridge.sim.servo import Servo
from hdbridge.sim.state import state
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.encoder import TrueDisc


@state
class Loops:
    """Servo loops and mechanics of the axis, run substep by substep."""

    servo: Servo
    plant: Plant
    dt_s: float
    """Length of a substep."""
    torque_nm: float
    """Torque of the motor at the end of the last cycle."""
    torque_squares: float
    """Sum of the squared motor torque over the substeps of the last cycle, Nm^2."""
    body: Body
    _disc: Disc
    _late_demand: Late
    _late_load: Late
    _late_motor: Late
    _plain: bool
    """True if the demand is not delayed and the encoders are ideal."""
    _rounded_nm: float
    """Largest rounding error of the reported torque: half a thousandth of the rated torque."""
    _off_deg: float
    _with_body: bool
    _with_disc: bool
    _with_late_demand: bool
    _with_late_load: bool
    _with_late_motor: bool

    def __init__(self, truth: Truth, *, loaded: bool = False) -> None:
        """``loaded`` allows an external torque on the load."""
        dt_s = self.dt_s = truth.substep_s
        motor, load = truth.motor.encoder, truth.load_.encoder
        self.plant = LoadedPlant(truth) if loaded or LoadedPlant.needed(truth) else Plant(truth)
        self.servo = Servo(truth)
        self.torque_nm = self.torque_squares = self._off_deg = 0.0
        self._rounded_nm = 0.0005 * truth.motor.rated_torque_nm
        self._with_disc = motor.disc is not None
        self._disc = Disc(motor.disc or TrueDisc(radius_mm=1.0))
        self.body = Body(load, dt_s)
        self._with_body = self.body.moves
        self._with_late_motor = bool(motor.late_ms)
        self._late_motor = Late(motor.late_ms / 1e3, dt_s, self.plant.now.motor_deg)
        self._with_late_load = bool(load.late_ms)
        self._late_load = Late(load.late_ms / 1e3, dt_s, self.plant.encoder_deg)
        self._with_late_demand = bool(truth.servo.dead_time_ms)
        self._late_demand = Late(truth.servo.dead_time_ms / 1e3, dt_s, 0.0)
        wrong = self._with_disc or bool(motor.losses)
        late = self._with_late_motor or self._with_late_load or self._with_late_demand
        self._plain = not (wrong or late or self._with_body)

    def take(
        self, temperature_c: float, friction: float, limit_nm: float, lost_deg: float, outer_nm: float
    ) -> None:
        """Sets the inputs that change only from cycle to cycle.

        These are the temperature, the motor's friction at this temperature relative to the truth file, the
        torque limit, the lost angle of the motor encoder, and the external torque on the load.
        """
        self.plant.now.temperature_c = temperature_c
        self.plant.scale_friction(friction)
        self.servo.limit_nm = limit_nm
        self._off_deg = lost_deg
        self.plant.outer_nm = outer_nm

    def switch_on(self) -> float:
        """Starts the loops at the motor angle that they measure, and returns that angle."""
        return self.servo.engage(self._seen_deg(self.plant.now.motor_deg), self.plant.motor_deg_s)

    def sampled_motor_deg(self) -> float:
        """Returns the motor angle at the time at which its encoder is sampled."""
        return self._late_motor.deg if self._with_late_motor else self.plant.now.motor_deg

    def sampled_load_deg(self) -> float:
        """Returns the angle of the load encoder's shaft at the time at which the encoder is sampled."""
        return self._late_load.deg if self._with_late_load else self.plant.encoder_deg

    def begin_demand(self, demand_deg: float) -> None:
        """Resets the delay to a demand that has always been constant."""
        self._late_demand.begin(demand_deg)

    def hold(self, torque_nm: float) -> None:
        """Shifts the integral so that the motor's torque at rest rounds to the reading ``torque_nm``."""
        off_nm = torque_nm - self.torque_nm
        off_nm -= min(max(off_nm, -self._rounded_nm), self._rounded_nm)
        self.servo.shift(off_nm)
        self.torque_nm += off_nm

    def follow(self, demand_deg: float, demand_deg_s: float, substeps: int) -> None:
        """Runs some substeps in closed loop, during which the demand moves linearly."""
        servo, plant, dt = self.servo, self.plant, self.dt_s
        now = plant.now
        torque = squares = 0.0
        if self._plain:
            for substep in range(substeps):
                torque = servo.answer_nm(
                    demand_deg + substep * dt * demand_deg_s, demand_deg_s, now.motor_deg
                )
                plant.step(torque, 0.0)
                squares += torque * torque
        else:
            late = self._late_demand
            for substep in range(substeps):
                place_deg, speed_deg_s = demand_deg + substep * dt * demand_deg_s, demand_deg_s
                if self._with_late_demand:
                    place_deg = late.deg
                    late.feed(demand_deg + (substep + 1) * dt * demand_deg_s)
                    speed_deg_s = (late.deg - place_deg) / dt
                torque = servo.answer_nm(place_deg, speed_deg_s, self._seen_deg(now.motor_deg))
                plant.step(torque, 0.0)
                self._watch()
                squares += torque * torque
        self.torque_nm, self.torque_squares = torque, squares

    def coast(self, brake_nm: float, substeps: int) -> None:
        """Runs some substeps with the power stage off."""
        self.torque_nm = self.torque_squares = 0.0
        for _ in range(substeps):
            self.plant.step(0.0, brake_nm)
            if not self._plain:
                self._watch()
        self.switch_on()

    def _seen_deg(self, motor_deg: float) -> float:
        """Returns the motor angle as measured by its encoder, before rounding."""
        if self._with_disc:
            motor_deg += self._disc.error_deg(motor_deg)
        return motor_deg + self._off_deg

    def _watch(self) -> None:
        """Updates the delays and the encoder's body by one substep."""
        plant = self.plant
        if self._with_late_motor:
            self._late_motor.feed(plant.now.motor_deg)
        if self._with_late_load:
            self._late_load.feed(plant.encoder_deg)
        if self._with_body:
            self.body.feed(plant.encoder_deg)
