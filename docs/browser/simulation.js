// The simulation of a scene: controllers act, kernels fly, results are kept for pictures.

const KEPT = 1500; // samples of the plots, 30 s
const TRAIL = 200; // points of the trails, 4 s
const PAUSE = 10; // duration of an outage [s]
const GUST = 1; // duration of a gust [s]
const GUST_FORCE = 3; // [N], to the east
const GNSS = 0, CAMERA = 1;
const FEATURES = 3; // first block of the camera
const SCALED = ["position_sigma_I", "velocity_sigma", "baseline_sigma", "baseline_noise", "pixel_sigma", "aid_sigma"];
const ROWS = [3, 4, 5, 6, 7, 8, 0, 1, 2, 9, 10, 11, 12, 13, 14]; // in memory, of r, v, e, b_a, b_g

// L, lower triangular, of P = L L^T for a positive definite matrix.
function lowerFactor(P) {
  const L = P.map((row) => row.map(() => 0));
  P.forEach((row, i) => {
    for (let j = 0; j <= i; j++) {
      let rest = row[j];
      for (let m = 0; m < j; m++) rest -= L[i][m] * L[j][m];
      L[i][j] = i === j ? Math.sqrt(rest) : rest / L[j][j];
    }
  });
  return L;
}

class Simulation {
  constructor(scenes, policies) {
    Object.assign(this, { scenes, policies, noise: 1, assumed: false, latency: 1 });
    for (const flights of Object.values(scenes)) {
      const copy = (record) => SCALED.map((name) => Array.from(flights.params(record, name)));
      const delay = Array.from(flights.settings("sensor_delay"), Number);
      flights.nominal = { own: copy("own"), model: copy("model"), delay };
    }
  }

  begin(name, seed) {
    this.flights = this.scenes[name];
    this.name = name;
    this.seed = seed;
    this.events = [];
    this.biased = false;
    this.setNoise(this.noise, this.assumed);
    this.setLatency(this.latency);
    this.flights.reset(seed);
    this.pilots = Array.from({ length: CONTROLLERS }, () => ({
      over: null, trail: [], turns: [], guess: [], fixes: [], image: { time: -1, pixels: [], count: 0 },
      error: [], estimation: [], nees: [], times: [],
    }));
    this.path = this.referencePath();
    this.keep();
  }

  // Fly a control period.
  step() {
    const { flights } = this, now = flights.time;
    while (this.events.length && this.events[0].time <= now) this.events.shift().end();
    for (let k = 0; k < CONTROLLERS; k++) {
      if (!this.pilots[k].over) flights.actions[k].set(this.action(k));
    }
    flights.step();
    this.keep();
  }

  // The action of a controller in [-1, 1], in single precision as in Python.
  action(k) {
    const { flights } = this;
    const policy = k === 0 ? null : this.policies[flights.info.trained][k === 1 ? "truth" : "estimate"];
    const action = policy ? networkOutput(policy, this.inputs(k, policy)) : pdAction(flights, k);
    return Array.from(action, (x) => Math.fround(clip(x, -1, 1)));
  }

  // What a network observes: the built-in observation and, in LookAround, direction of the markers
  // and logarithm of the position's standard deviation.
  inputs(k, policy) {
    const { flights } = this, builtin = flights.observations[k], size = policy[0].weights.length / policy[0].biases.length;
    const inputs = new Float32Array(size);
    inputs.set(builtin);
    if (size > builtin.length) {
      const R = flights.field(k, "R_seen"), features = this.features(), count = features.length;
      const center = scaled(1 / count, sum(...features));
      inputs.set(turned(R, unit(sum(center, scaled(-1, flights.field(k, "r_seen"))))), builtin.length);
    }
    if (size > builtin.length + 3) {
      const sigma = Math.sqrt(Math.max(...this.covariance(k).slice(0, 3).map((row, i) => row[i])));
      inputs[size - 1] = clip(Math.log10(Math.max(sigma, 1e-9) / 0.03), -1, 6);
    }
    return inputs;
  }

  features() {
    const all = this.flights.params("own", "features");
    return Array.from({ length: this.flights.info.features }, (_, i) => Array.from(all.subarray(3 * i, 3 * i + 3)));
  }

  // The lower factor of the covariance of the position, in I.
  positionRoot(k) {
    return lowerFactor(this.covariance(k).slice(0, 3).map((row) => row.slice(0, 3)));
  }

  // The covariance of the 15 states in the order r, v, e, b_a, b_g, from its lower triangle in memory.
  covariance(k) {
    const P = this.flights.field(k, "P");
    return ROWS.map((a) => ROWS.map((b) => P[15 * Math.max(a, b) + Math.min(a, b)]));
  }

  // ---- results ---------------------------------------------------------------------------------

  keep() {
    const { flights } = this, time = flights.time;
    for (let k = 0; k < CONTROLLERS; k++) {
      const pilot = this.pilots[k];
      if (pilot.over) continue;
      const r = Array.from(flights.field(k, "r")), guess = Array.from(flights.field(k, "r_hat"));
      const add = (list, value, most) => { list.push(value); if (list.length > most) list.shift(); };
      add(pilot.trail, r, TRAIL);
      add(pilot.turns, attitude(flights.field(k, "q")), TRAIL);
      add(pilot.guess, guess, TRAIL);
      add(pilot.times, time, KEPT);
      add(pilot.error, flights.field(k, "position_error")[0], KEPT);
      add(pilot.estimation, Math.hypot(...sum(r, scaled(-1, guess))), KEPT);
      add(pilot.nees, this.nees(k), KEPT);
      const fresh = flights.field(k, "block_fresh");
      if (time > 0 && flights.info.gnss && fresh[0] > 0) add(pilot.fixes, this.fix(k, time), 20);
      this.keepImage(k, time, fresh);
      if (flights.field(k, "terminated")[0] > 0) pilot.over = { time };
    }
  }

  // The GNSS fix that has arrived: where the vehicle was by it, with the true attitude, and in truth.
  fix(k, time) {
    const { flights } = this, { trail, turns } = this.pilots[k], east = flights.params("model", "R_IG");
    const steps = Math.round(Number(flights.settings("sensor_delay")[GNSS]) / flights.info.ticksPerStep);
    const stamp = Math.max(trail.length - 1 - steps, 0);
    const arm = turnedBack(turns[stamp], Array.from(flights.params("model", "antenna")));
    const place = sum(turned(east, flights.field(k, "measurement").subarray(0, 3)), scaled(-1, arm));
    return { time, place, real: trail[stamp] };
  }

  keepImage(k, time, fresh) {
    const { image } = this.pilots[k], z = this.flights.field(k, "measurement"), seen = [];
    for (let i = 0; i < this.flights.info.features; i++) {
      const block = FEATURES + i;
      if (fresh[block] > 0) seen.push({ feature: i, x: z[3 * block], y: z[3 * block + 1] });
    }
    if (seen.length) this.pilots[k].image = { time, pixels: seen, count: image.count + 1 };
  }

  // Normalized estimation error squared of the 15 states: |L^-1 e|^2.
  nees(k) {
    const { flights } = this, f = (name) => flights.field(k, name);
    const difference = (a, b) => [0, 1, 2].map((i) => f(a)[i] - f(b)[i]);
    const R = attitude(f("q")), R_hat = f("R_hat");
    const row = (M, i) => [M[3 * i], M[3 * i + 1], M[3 * i + 2]];
    const E = (i, j) => dot(row(R, i), row(R_hat, j));
    const angles = [
      Math.atan2(E(1, 2), Math.hypot(E(1, 0), E(1, 1))), Math.atan2(-E(0, 2), E(2, 2)), Math.atan2(-E(1, 0), E(1, 1)),
    ];
    const e = [
      ...difference("r", "r_hat"), ...difference("v", "v_hat"), ...angles,
      ...difference("b_a", "b_a_hat"), ...difference("b_g", "b_g_hat"),
    ];
    const L = lowerFactor(this.covariance(k)), x = [];
    for (let i = 0; i < 15; i++) {
      let rest = e[i];
      for (let j = 0; j < i; j++) rest -= L[i][j] * x[j];
      x.push(rest / L[i][i]);
    }
    return x.reduce((total, number) => total + number * number, 0);
  }

  // The reference r*(t) = c + sum_k a_k cos(k w t) + b_k sin(k w t).
  reference(time) {
    const { flights } = this, f = (name) => flights.field(0, name);
    const a = f("ref_cos"), b = f("ref_sin"), place = Array.from(f("ref_center"));
    for (let h = 0; h < flights.info.harmonics; h++) {
      const angle = (h + 1) * f("ref_omega")[0] * time;
      for (let i = 0; i < 3; i++) place[i] += a[3 * h + i] * Math.cos(angle) + b[3 * h + i] * Math.sin(angle);
    }
    return place;
  }

  referencePath() {
    const period = (2 * Math.PI) / this.flights.field(0, "ref_omega")[0];
    return Array.from({ length: 121 }, (_, i) => this.reference((period * i) / 120));
  }

  // ---- buttons and sliders ---------------------------------------------------------------------

  // Switch a sensor off and, after a pause, on again, as `FlightBatch.switch_sensors` does.
  outage(sensor, seconds = PAUSE) {
    const set = (wait) => {
      for (let k = 0; k < CONTROLLERS; k++) this.flights.field(k, "wait")[sensor] = wait;
    };
    set(Infinity);
    this.after(seconds, `off ${sensor}`, () => set(0));
  }

  gust(seconds = GUST) {
    const set = (force) => {
      for (let k = 0; k < CONTROLLERS; k++) this.flights.field(k, "disturbance")[0] = force;
    };
    set(GUST_FORCE);
    this.after(seconds, "gust", () => set(0));
  }

  // Add the step to the gyros' true biases, or take it back, as `FlightBatch.switch_faults` does.
  biasStep() {
    const { flights } = this, fault = flights.info.biasFault;
    this.biased = !this.biased;
    for (let k = 0; k < CONTROLLERS; k++) {
      const tick = flights.field(k, "tick")[0];
      if (this.biased) flights.field(k, "fault_from")[fault] = tick;
      flights.field(k, "fault_until")[fault] = this.biased ? Infinity : tick;
    }
  }

  after(seconds, what, end) {
    this.events = this.events.filter((event) => event.what !== what);
    this.events.push({ time: this.flights.time + seconds, what, end });
    this.events.sort((a, b) => a.time - b.time);
  }

  isOn(what) {
    return this.events.some((event) => event.what === what);
  }

  // Scale the true noise of GNSS, camera and other sensors and, if `assumed`, the filter's, too.
  setNoise(factor, assumed) {
    Object.assign(this, { noise: factor, assumed });
    for (const [record, times] of [["own", factor], ["model", assumed ? factor : 1]]) {
      SCALED.forEach((name, i) => {
        this.flights.params(record, name).set(scaled(times, this.flights.nominal[record][i]));
      });
    }
  }

  // Scale the latency of GNSS and camera. Measurements that have arrived do not arrive again.
  setLatency(factor) {
    this.latency = factor;
    const { flights } = this, delays = flights.settings("sensor_delay"), ticks = flights.settings("sensor_ticks");
    const [slots, length] = flights.info.stamps;
    for (const sensor of [GNSS, CAMERA]) {
      const before = Number(delays[sensor]), delay = Math.round(factor * flights.nominal.delay[sensor]);
      if (flights.nominal.delay[sensor] === 0) continue;
      delays[sensor] = BigInt(delay);
      flights.settings("under_way")[sensor] = BigInt(Math.ceil(delay / Number(ticks[sensor])));
      for (let k = 0; k < CONTROLLERS; k++) {
        const stamps = flights.field(k, "stamps"), tick = flights.field(k, "tick")[0];
        for (let slot = 0; slot < slots; slot++) {
          const place = length * (slots * sensor + slot);
          if (tick - stamps[place] >= before) stamps[place] = NaN;
        }
      }
    }
  }
}

// R_BI, rows one after another, of a quaternion (w, x, y, z).
function attitude([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y),
  ];
}
