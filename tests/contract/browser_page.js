// What the browser does in the test of the page; SEED, FLOWN and ADDRESS are given.

const press = (id) => element(id).click();
const slide = (id, value) => {
  element(id).value = value;
  element(id).dispatchEvent(new Event("input"));
};
function flown(name, steps, every, fields, buttons, noiseAt, latencyAt) {
  slide("noise", 0);
  slide("latency", 1);
  page.choose(name, SEED);
  const { simulation } = page, { flights } = simulation, actions = [], rows = [], nees = [];
  for (let i = 0; i < steps; i++) {
    if (buttons[i]) press(buttons[i]);
    if (i === noiseAt) slide("noise", 1);
    if (i === latencyAt) slide("latency", 1.5);
    simulation.step();
    actions.push([0, 1, 2].map((k) => Array.from(flights.actions[k])));
    if ((i + 1) % every) continue;
    page.draw();
    const numbers = (k) => fields.flatMap((field) => Array.from(flights.field(k, field)));
    const row = Float64Array.from([0, 1, 2].flatMap(numbers));
    rows.push(btoa(String.fromCharCode(...new Uint8Array(row.buffer))));
    nees.push([0, 1, 2].map((k) => simulation.nees(k)));
  }
  return { actions, rows, nees, over: simulation.pilots.map((pilot) => pilot.over) };
}

async function report() {
  const flights = {};
  page.running = false;
  for (const name of Object.keys(DATA.scenes)) flights[name] = flown(name, ...FLOWN);
  page.running = true;
  page.choose("circle", 1);
  const frames = [], { draw } = page;
  page.draw = () => {
    const before = performance.now();
    draw.call(page);
    frames.push(performance.now() - before);
  };
  await new Promise((done) => setTimeout(done, 3000));
  return { flights, frames, flown: page.simulation.flights.time };
}

const errors = [];
window.addEventListener("error", (event) => errors.push(event.message));
window.addEventListener("unhandledrejection", (event) => errors.push(String(event.reason)));
const waiting = setInterval(() => {
  if (page === null) return;
  clearInterval(waiting);
  report().catch((error) => ({ failed: error.stack })).then((found) => fetch(ADDRESS, {
    method: "POST", mode: "no-cors", body: JSON.stringify({ ...found, errors }),
  }));
}, 20);
