// Controllers: PD control, and trained networks. All observe the estimate alone.

const clip = (x, low, high) => Math.min(Math.max(x, low), high);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (s, a) => a.map((x) => s * x);
const sum = (...vectors) => vectors[0].map((_, i) => vectors.reduce((total, v) => total + v[i], 0));
const unit = (a) => scaled(1 / Math.max(Math.hypot(...a), 1e-9), a);
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
// R v, and R^T v, with R in rows.
const turned = (R, v) => [0, 1, 2].map((i) => R[3 * i] * v[0] + R[3 * i + 1] * v[1] + R[3 * i + 2] * v[2]);
const turnedBack = (R, v) => [0, 1, 2].map((i) => R[i] * v[0] + R[i + 3] * v[1] + R[i + 6] * v[2]);

// Thrust and body rates of PD control, as `baselines.PDPolicy` computes them.
function pdAction(flights, k) {
  const { observation, gains } = flights.info;
  const part = (name) => Array.from(flights.observations[k].subarray(...observation[name]));
  const [mass] = flights.params("model", "mass"), [gravity] = flights.params("model", "gravity");
  const up = part("up"), weight = mass * gravity;
  let F = sum(
    scaled(gains.position, part("position_error")), scaled(gains.velocity, part("velocity_error")),
    scaled(weight, up), scaled(mass, part("reference_acceleration")),
  );
  const lift = dot(F, up), sideways = sum(F, scaled(-lift, up)), most = Math.max(lift, 0.3 * weight);
  const share = Math.min(1, (1.2 * most) / Math.max(Math.hypot(...sideways), 1e-9));
  F = sum(scaled(most, up), scaled(share, sideways));
  const z = unit(F), b = unit(cross(z, part("heading"))), a = cross(b, z);
  const e = [b[2] - z[1], z[0] - a[2], a[1] - b[0]];
  const scale = flights.params("model", "rate_scale");
  const rates = e.map((x, i) => (gains.attitude[i] / gains.body_rates[i]) * x / scale[i]);
  return [F[2] / weight - 1, ...rates];
}

// Networks by task and source, from the shapes of their layers and all weights in one array.
function networksOf(layers, weights) {
  let place = 0;
  const next = (count) => weights.subarray(place, (place += count));
  const network = (shapes) => shapes.map(([outputs, inputs, activation]) => (
    { weights: next(outputs * inputs), biases: next(outputs), activation }
  ));
  const each = (values, change) => Object.fromEntries(Object.entries(values).map(([name, value]) => [name, change(value)]));
  return each(layers, (sources) => each(sources, network));
}

// Output of a network with layers x <- activation(W x + b).
function networkOutput(layers, inputs) {
  let x = inputs;
  for (const { weights, biases, activation } of layers) {
    const size = x.length, y = new Float32Array(biases.length);
    for (let i = 0; i < y.length; i++) {
      let total = biases[i];
      for (let j = 0; j < size; j++) total += weights[i * size + j] * x[j];
      y[i] = activation === "relu" ? Math.max(total, 0) : total;
    }
    x = y;
  }
  return x;
}
