// The page: pictures, plots, buttons and sliders.

const element = (id) => document.getElementById(id);
const METERS = (value) => (value >= 1 ? `${value} m` : value >= 0.01 ? `${100 * value} cm` : `${1000 * value} mm`);
const length = (value) => (value < 1 ? `${(100 * value).toFixed(1)} cm` : `${value.toFixed(2)} m`);
const COLORS = ["text", "grid", "faint", "inset", "band", "truth", "estimate", "fix", "ray"];

class Page {
  constructor(simulation) {
    Object.assign(this, { simulation, eye: new Eye(), running: true, last: null, owed: 0 });
    const canvases = [...document.querySelectorAll(".flight canvas")];
    this.pictures = canvases.map((canvas) => new Picture(canvas, this.eye));
    const errors = { low: 0.001, high: 10, unitOf: METERS };
    this.plots = [
      new Plot(element("error"), { title: "Distance from the reference", quantity: "error", ...errors }),
      new Plot(element("estimation"), { title: "Error of the estimated position", quantity: "estimation", ...errors }),
      new Plot(element("nees"), {
        title: "NEES of 15 states; band: 95 % if consistent", quantity: "nees", low: 1, high: 10000, unitOf: String,
        band: [6.262, 27.488],
      }),
    ];
    const options = Object.entries(simulation.scenes).map(([name, { info }]) => new Option(info.title, name));
    element("scene").append(...options);
    this.listen();
    canvases.forEach((canvas) => this.turn(canvas));
    this.choose(options[0].value, 1);
  }

  listen() {
    const on = (id, event, act) => element(id).addEventListener(event, act);
    const { simulation } = this;
    on("scene", "change", () => this.choose(element("scene").value, simulation.seed));
    on("again", "click", () => this.choose(simulation.name, simulation.seed + 1));
    on("pause", "click", () => {
      this.running = !this.running;
      element("pause").textContent = this.running ? "Pause" : "Continue";
    });
    on("gnss", "click", () => simulation.outage(GNSS));
    on("camera", "click", () => simulation.outage(CAMERA));
    on("gust", "click", () => simulation.gust());
    on("bias", "click", () => simulation.biasStep());
    const noise = () => {
      simulation.setNoise(2 ** Number(element("noise").value), element("assumed").checked);
      element("noise-value").textContent = `× ${Number(simulation.noise.toPrecision(2))}`;
    };
    on("noise", "input", noise);
    on("assumed", "change", noise);
    on("latency", "input", () => {
      simulation.setLatency(Number(element("latency").value));
      this.showLatency();
    });
    on("follow", "change", () => {
      this.eye.follows = element("follow").checked;
      this.eye.distance = this.eye.follows ? 6 : 15;
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.readColors());
  }

  choose(name, seed) {
    const { simulation } = this;
    simulation.begin(name, seed);
    const { info } = simulation.flights;
    element("gnss").disabled = !info.gnss;
    element("camera").disabled = !info.features;
    element("magnified").value = info.magnified;
    element("included").textContent = info.included;
    this.readColors();
    this.showLatency();
  }

  showLatency() {
    const { flights } = this.simulation, delays = flights.settings("sensor_delay"), words = [];
    for (const [sensor, name] of [[GNSS, "GNSS"], [CAMERA, "camera"]]) {
      if (flights.nominal.delay[sensor]) words.push(`${name} ${Math.round(1000 * Number(delays[sensor]) * flights.info.tick)} ms`);
    }
    element("latency-value").textContent = words.join(", ");
  }

  readColors() {
    const style = getComputedStyle(document.documentElement), read = (name) => style.getPropertyValue(`--${name}`).trim();
    this.colors = Object.fromEntries(COLORS.map((name) => [name, read(name)]));
    this.colors.pilots = ["pd", "on-truth", "on-estimate"].map(read);
  }

  // Turn the eye by dragging, move it by the wheel or two fingers.
  turn(canvas) {
    const { eye } = this, held = new Map();
    const gap = () => {
      const [a, b] = [...held.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    const move = (factor) => { eye.distance = clip(factor * eye.distance, 1.5, 40); };
    canvas.addEventListener("pointerdown", (event) => {
      held.set(event.pointerId, { x: event.clientX, y: event.clientY });
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const now = { x: event.clientX, y: event.clientY }, width = held.size > 1 ? gap() : 0;
      held.set(event.pointerId, now);
      if (held.size > 1) return move(width / Math.max(gap(), 1));
      eye.azimuth -= 0.008 * (now.x - before.x);
      eye.elevation = clip(eye.elevation + 0.008 * (now.y - before.y), -0.2, 1.5);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => held.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      move(Math.exp(0.001 * event.deltaY));
    }, { passive: false });
  }

  // Fly in real time, at most five control periods a frame, and draw.
  frame(now) {
    const { simulation } = this, period = simulation.flights.info.tick * simulation.flights.info.ticksPerStep;
    if (this.running && this.last !== null) this.owed += Math.min((now - this.last) / 1000, 5 * period);
    this.last = now;
    for (; this.owed >= period; this.owed -= period) simulation.step();
    this.draw();
    requestAnimationFrame((time) => this.frame(time));
  }

  draw() {
    const { simulation, colors } = this, magnified = Number(element("magnified").value);
    this.pictures.forEach((picture, k) => picture.draw(simulation, k, colors, magnified));
    this.plots.forEach((plot) => plot.draw(simulation, colors));
    simulation.pilots.forEach((pilot, k) => {
      const last = (list) => list[list.length - 1];
      element(`state-${k}`).textContent = pilot.over
        ? `crashed after ${pilot.over.time.toFixed(1)} s`
        : `tracking error ${length(last(pilot.error))}, estimation error ${length(last(pilot.estimation))}`;
    });
    element("time").textContent = `${simulation.flights.time.toFixed(1)} s`;
    for (const [id, what] of [["gnss", `off ${GNSS}`], ["camera", `off ${CAMERA}`], ["gust", "gust"]]) {
      element(id).setAttribute("aria-pressed", simulation.isOn(what));
    }
    element("bias").setAttribute("aria-pressed", simulation.biased);
  }
}

let page = null;
loaded(DATA).then(async (scenes) => {
  const policies = networksOf(DATA.policies, new Float32Array(await unpacked(DATA.weights)));
  page = new Page(new Simulation(scenes, policies));
  element("wait").remove();
  requestAnimationFrame((now) => page.frame(now));
}).catch((error) => {
  element("wait").textContent = `The kernels cannot run in this browser: ${error.message}`;
});
