// Flights in WebAssembly's memory: fields of records by name, and the calls of the kernels.

const CONTROLLERS = 3;
const RESET = 1n, STEP = 0n;

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// Load the kernels and the records of all scenes; returns the scenes by name.
async function loaded(data) {
  const { instance } = await WebAssembly.instantiate(await unpacked(data.module), {});
  const { memory } = instance.exports;
  if (instance.exports.__heap_base.value > data.base) throw new Error("memory overlaps the stack");
  const missing = Math.ceil((data.base + data.size) / 65536) - memory.buffer.byteLength / 65536;
  if (missing > 0) memory.grow(missing);
  new Uint8Array(memory.buffer).set(new Uint8Array(await unpacked(data.memory)), data.base);
  const scenes = {};
  for (const [name, info] of Object.entries(data.scenes)) {
    scenes[name] = new Flights(instance.exports, info);
  }
  return scenes;
}

// The flights of a scene, one for each controller, with the same draws.
class Flights {
  constructor(kernels, info) {
    Object.assign(this, { kernels, info, buffer: kernels.memory.buffer });
    const table = new BigUint64Array(this.buffer, info.places.stages);
    for (const [slot, stage] of info.stages) table[slot] = BigInt(kernels.stage_address(stage));
    const place = info.places;
    this.observations = [];
    this.actions = [];
    for (let k = 0; k < CONTROLLERS; k++) {
      const size = info.observationSize;
      this.observations.push(new Float32Array(this.buffer, place.observations + 4 * size * k, size));
      this.actions.push(new Float64Array(this.buffer, place.actions + 32 * k, 4));
    }
    this.initial = new Uint8Array(this.buffer, place.blocks, CONTROLLERS * info.pitch).slice();
  }

  // A field of the record of a flight, as numbers that kernels read and write.
  field(k, name) {
    const [offset, length] = this.info.flight[name];
    return new Float64Array(this.buffer, this.info.places.blocks + k * this.info.pitch + offset, length);
  }

  // A field of the true parameters ("own"), or of those that filter and controllers assume ("model").
  params(record, name) {
    const [offset, length] = this.info.params[name];
    return new Float64Array(this.buffer, this.info.places[record] + offset, length);
  }

  // A field of the settings, whole numbers.
  settings(name) {
    const [offset, length] = this.info.settings[name];
    return new BigInt64Array(this.buffer, this.info.places.settings + offset, length);
  }

  reset(seed) {
    new Uint8Array(this.buffer).set(this.initial, this.info.places.blocks);
    for (let k = 0; k < CONTROLLERS; k++) {
      const key = this.field(k, "key");
      new BigUint64Array(this.buffer, key.byteOffset, 2).set([BigInt(seed), 0n]);
    }
    new Uint8Array(this.buffer, this.info.places.resets, CONTROLLERS).fill(1);
    this.run(RESET);
  }

  step() {
    this.run(STEP);
  }

  // Call `quad_gym.kernels.batch.fly`, as the only thread.
  run(command) {
    const { call, board, boardSize, result } = this.info;
    this.kernels.qg_core_fly(result, 0, BigInt(call), BigInt(board), BigInt(boardSize), 0n, command, 0);
  }

  get time() {
    return this.field(0, "tick")[0] * this.info.tick;
  }
}
