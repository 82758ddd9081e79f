// Periodic error: mean transmission error over the motor turn, and over motor and load angle.
// Pure: numbers in, numbers out.

export const MOTOR_BINS = 72;
export const LOAD_BINS = 36;
export const ORDERS = 12;
const NEEDED = 0.9; // share of the turn that must be covered: below that, orders are not separable
const HALF_LIFE_S = 120; // so that the picture follows what changes

const turn = (deg) => ((deg % 360) + 360) % 360;

/** Means in bins of motor angle (from 0) and load angle (from -180 deg), with less weight on older samples. */
export class Means {
  constructor() {
    this.clear();
  }

  clear() {
    this.weight = new Float64Array(MOTOR_BINS * LOAD_BINS);
    this.sum = new Float64Array(MOTOR_BINS * LOAD_BINS);
  }

  fade(seconds) {
    const factor = 0.5 ** (Math.max(0, seconds) / HALF_LIFE_S);
    for (let n = 0; n < this.sum.length; n += 1) {
      this.weight[n] *= factor;
      this.sum[n] *= factor;
    }
  }

  add(motorDeg, loadDeg, value) {
    if (!Number.isFinite(motorDeg) || !Number.isFinite(loadDeg) || !Number.isFinite(value)) return;
    const motor = Math.min(MOTOR_BINS - 1, Math.floor((turn(motorDeg) / 360) * MOTOR_BINS));
    const load = Math.min(LOAD_BINS - 1, Math.floor((turn(loadDeg + 180) / 360) * LOAD_BINS));
    this.weight[load * MOTOR_BINS + motor] += 1;
    this.sum[load * MOTOR_BINS + motor] += value;
  }

  /** Mean of each cell, NaN without samples, minus the mean of all, because the zero is arbitrary. */
  map() {
    const cells = Array.from(this.sum, (sum, n) => (this.weight[n] > 1e-3 ? sum / this.weight[n] : NaN));
    const known = cells.filter(Number.isFinite);
    const mean = known.reduce((a, b) => a + b, 0) / (known.length || 1);
    return cells.map((each) => each - mean);
  }

  /** Mean over the motor turn; each load angle has equal weight. */
  overMotor() {
    const cells = this.map();
    return Array.from({ length: MOTOR_BINS }, (_, motor) => {
      let sum = 0;
      let count = 0;
      for (let load = 0; load < LOAD_BINS; load += 1) {
        const value = cells[load * MOTOR_BINS + motor];
        if (Number.isFinite(value)) {
          sum += value;
          count += 1;
        }
      }
      return count ? sum / count : NaN;
    });
  }
}

/** Amplitudes of the orders 1.. of a turn from means in equal bins; null if too few bins have samples. */
export function orders(means, count = ORDERS) {
  const known = means.map((value, n) => [value, (2 * Math.PI * (n + 0.5)) / means.length]).filter(([value]) => Number.isFinite(value));
  if (known.length < NEEDED * means.length) return null;
  const mean = known.reduce((sum, [value]) => sum + value, 0) / known.length;
  return Array.from({ length: count }, (_, k) => {
    let a = 0;
    let b = 0;
    for (const [value, phase] of known) {
      a += (value - mean) * Math.cos((k + 1) * phase);
      b += (value - mean) * Math.sin((k + 1) * phase);
    }
    // A bin is a mean over its width, which lowers the amplitude by this factor.
    const half = ((k + 1) * Math.PI) / means.length;
    return ((2 / known.length) * Math.hypot(a, b) * half) / Math.sin(half);
  });
}

export const covered = (means) => means.filter(Number.isFinite).length / means.length;
