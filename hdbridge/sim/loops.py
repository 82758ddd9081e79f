"""Substeps of the simulated axis: the drive's loops, the mechanics, and the sampling of the encoders.

`hdbridge.sim.machine` calls it once per control cycle. All inputs and outputs are numbers, so that it can be
compiled as a whole.
"""

from hdbridge.sim.encoder import Body, Disc, Late
from hdbridge.sim.loaded_plant import LoadedPlant
from hdbridge.sim.plant import Plant
from hdbridge.sim.servo import Servo
from hdbridge.sim.state import state
from hdbridge.sim.truth import Truth
from hdbridge.sim.truth.encoder import TrueDisc

Seen = tuple[float, float, float, float, float, float, float, float, float, float, float]
"""Results of a cycle: the motor's angle, and when its encoder was sampled; the load's angle; that of its
encoder's shaft when it was sampled, and the shift of that encoder's body; the gear's output (all
deg); the motor's speed as measured by the drive (deg/s); gravity's torque on the load (Nm); the
motor's torque (Nm), and the sum of its squares over the substeps; the friction work at the motor
shaft (J)."""

Slow = tuple[float, float, float, float, float]
"""Inputs that change only from cycle to cycle: the temperature, the motor's friction at it relative to the
truth file, the torque limit (Nm), the lost angle of the motor encoder (deg), the external torque on the load
(Nm)."""


@state
class Loops:
    """Servo axis, substep by substep."""

    servo: Servo
    plant: Plant
    dt_s: float
    """Length of a substep."""
    _body: Body
    _disc: Disc
    _late_demand: Late
    _late_load: Late
    _late_motor: Late
    _plain: bool
    """True if the demand is not delayed and the encoders are ideal."""
    _rounded_nm: float
    """Largest rounding error of the torque that the drive reports: half a thousandth of the rated one."""
    _torque_nm: float
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
        self._torque_nm, self._rounded_nm = 0.0, 0.0005 * truth.motor.rated_torque_nm
        self._with_disc = motor.disc is not None
        self._disc = Disc(motor.disc or TrueDisc(radius_mm=1.0))
        self._body = Body(load, dt_s)
        self._with_body = self._body.moves
        self._with_late_motor = bool(motor.late_ms)
        self._late_motor = Late(motor.late_ms / 1e3, dt_s, self.plant.now.motor_deg)
        self._with_late_load = bool(load.late_ms)
        self._late_load = Late(load.late_ms / 1e3, dt_s, self.plant.encoder_deg)
        self._with_late_demand = bool(truth.servo.dead_time_ms)
        self._late_demand = Late(truth.servo.dead_time_ms / 1e3, dt_s, 0.0)
        wrong = self._with_disc or bool(motor.losses)
        late = self._with_late_motor or self._with_late_load or self._with_late_demand
        self._plain = not (wrong or late or self._with_body)

    def power_on(self, slow: Slow) -> float:
        """Switches the power stage on at the motor's angle, as the loops see it, and returns that angle."""
        return self._engage(self._take(slow))

    def _engage(self, lost_deg: float) -> float:
        return self.servo.engage(self._seen_deg(self.plant.now.motor_deg, lost_deg), self.plant.motor_deg_s)

    def begin_demand(self, demand_deg: float) -> None:
        """Resets to a demand that has always been this one."""
        self._late_demand.begin(demand_deg)

    def hold(self, torque_nm: float) -> None:
        """Shifts the integral so that the motor's torque at rest rounds to the reading ``torque_nm``."""
        off_nm = torque_nm - self._torque_nm
        off_nm -= min(max(off_nm, -self._rounded_nm), self._rounded_nm)
        self.servo.shift(off_nm)
        self._torque_nm += off_nm

    def follow(self, demand_deg: float, demand_deg_s: float, substeps: int, slow: Slow) -> Seen:
        """Runs some substeps in closed loop, in which the demand moves linearly."""
        lost_deg = self._take(slow)
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
                torque = servo.answer_nm(place_deg, speed_deg_s, self._seen_deg(now.motor_deg, lost_deg))
                plant.step(torque, 0.0)
                self._watch()
                squares += torque * torque
        self._torque_nm = torque
        return self._seen(squares)

    def coast(self, brake_nm: float, substeps: int, slow: Slow) -> Seen:
        """Runs some substeps with the power stage off."""
        lost_deg = self._take(slow)
        self._torque_nm = 0.0
        for _ in range(substeps):
            self.plant.step(0.0, brake_nm)
            if not self._plain:
                self._watch()
        self._engage(lost_deg)
        return self._seen(0.0)

    def seen(self) -> Seen:
        """Returns the initial state."""
        return self._seen(0.0)

    def _take(self, slow: Slow) -> float:
        """Applies the slowly varying inputs; returns the lost angle of the motor encoder."""
        temperature_c, friction, self.servo.limit_nm, lost_deg, outer_nm = slow
        self.plant.now.temperature_c = temperature_c
        self.plant.outer_nm = outer_nm
        self.plant.scale_friction(friction)
        return lost_deg

    def _seen(self, squares: float) -> Seen:
        """Returns the results of a cycle, and resets the friction work."""
        plant = self.plant
        now, loss_j = plant.now, plant.loss_j
        plant.loss_j = 0.0
        return (
            now.motor_deg,
            self._late_motor.deg if self._with_late_motor else now.motor_deg,
            now.load_deg,
            self._late_load.deg if self._with_late_load else plant.encoder_deg,
            self._body.deg,
            plant.output_deg,
            self.servo.measured_deg_s,
            plant.weight_nm(now.load_deg),
            self._torque_nm,
            squares,
            loss_j,
        )

    def _seen_deg(self, motor_deg: float, lost_deg: float) -> float:
        """Returns the motor's angle as seen by its encoder, before rounding."""
        if self._with_disc:
            motor_deg += self._disc.error_deg(motor_deg)
        return motor_deg + lost_deg

    def _watch(self) -> None:
        """Feeds the delays and the encoder's body with one substep."""
        plant = self.plant
        if self._with_late_motor:
            self._late_motor.feed(plant.now.motor_deg)
        if self._with_late_load:
            self._late_load.feed(plant.encoder_deg)
        if self._with_body:
            self._body.feed(plant.encoder_deg)
