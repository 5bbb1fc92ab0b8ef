// A picture in perspective: ground, reference, vehicle, estimate, fixes, camera.

const SIGHT = 0.6; // time for which fixes and images stay in the picture [s]

// The eye of all pictures of the page: turned and moved by the pointer.
class Eye {
  constructor() {
    Object.assign(this, { azimuth: 0.6, elevation: 0.4, distance: 6, follows: true });
  }

  // Look at a point (x, y, z) from the present direction, in a picture of this size.
  aim(target, width, height, distance = this.distance) {
    const { azimuth, elevation } = this;
    const ahead = [-Math.cos(elevation) * Math.cos(azimuth), -Math.cos(elevation) * Math.sin(azimuth), -Math.sin(elevation)];
    const right = unit(cross(ahead, [0, 0, 1]));
    Object.assign(this, { ahead, right, up: cross(right, ahead), width, height, focal: 1.1 * Math.min(width, 1.4 * height) });
    this.place = sum(target, scaled(-distance, ahead));
  }

  // Picture of a point, [x, y, pixels per meter], or null if it is behind the eye.
  see(point) {
    const d = [point[0] - this.place[0], point[1] - this.place[1], point[2] - this.place[2]];
    const depth = dot(d, this.ahead);
    if (depth < 0.1) return null;
    const scale = this.focal / depth;
    return [0.5 * this.width + scale * dot(d, this.right), 0.5 * this.height - scale * dot(d, this.up), scale];
  }
}

class Picture {
  constructor(canvas, eye) {
    Object.assign(this, { canvas, eye, context: canvas.getContext("2d") });
  }

  // Fit the canvas to its place on the page.
  fit() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), { canvas } = this;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(ratio * width) || canvas.height !== Math.round(ratio * height)) {
      canvas.width = Math.round(ratio * width);
      canvas.height = Math.round(ratio * height);
    }
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.context.clearRect(0, 0, width, height);
    return [width, height];
  }

  // Draw a flight; errors of the estimate are drawn `magnified` times.
  draw(simulation, k, colors, magnified) {
    const { flights } = simulation, pilot = simulation.pilots[k], [width, height] = this.fit();
    Object.assign(this, { colors, width, height });
    const r = pilot.trail[pilot.trail.length - 1], guess = pilot.guess[pilot.guess.length - 1];
    const near = (point, real) => sum(real, scaled(magnified, sum(point, scaled(-1, real))));
    // after a crash, between the vehicle and its estimate, from where both are in the picture
    const gap = sum(near(guess, r), scaled(-1, r)), apart = pilot.over ? Math.hypot(...gap) : 0;
    const target = this.eye.follows ? sum(r, scaled(pilot.over ? 0.5 : 0, gap)) : [0, 0, 1];
    this.eye.aim(target, width, height, Math.min(Math.max(this.eye.distance, 1.5 * apart), 60));
    this.ground(target);
    const R = pilot.turns[pilot.turns.length - 1];
    this.line(simulation.path, colors.faint, 1.5, [6, 5]);
    this.dot(simulation.reference(pilot.times[pilot.times.length - 1]), 3, colors.faint);
    this.markers(simulation, k, r, R);
    this.line(pilot.trail, colors.truth, 1.5);
    this.line(pilot.guess.map((point, i) => near(point, pilot.trail[i])), colors.estimate, 1.5);
    for (const { time, place, real } of pilot.fixes) {
      const age = simulation.flights.time - time;
      if (age < SIGHT) this.cross(near(place, real), colors.fix, 1 - age / SIGHT);
    }
    if (!pilot.over) {
      this.ellipsoid(near(guess, r), simulation.positionRoot(k).map((row) => scaled(3 * magnified, row)));
    }
    this.vehicle(flights, near(guess, r), pilot.over ? R : flights.field(k, "R_hat"), colors.estimate, false);
    this.vehicle(flights, r, R, pilot.over ? colors.faint : colors.truth, true);
    if (flights.info.features) this.image(simulation, k);
  }

  path(points, closed) {
    const { context } = this;
    let drawing = false;
    context.beginPath();
    for (const point of points) {
      const seen = this.eye.see(point);
      if (seen && drawing) context.lineTo(seen[0], seen[1]);
      else if (seen) context.moveTo(seen[0], seen[1]);
      drawing = seen !== null;
    }
    if (closed) context.closePath();
  }

  line(points, color, width, dash = []) {
    this.path(points, false);
    Object.assign(this.context, { strokeStyle: color, lineWidth: width });
    this.context.setLineDash(dash);
    this.context.stroke();
    this.context.setLineDash([]);
  }

  dot(point, radius, color) {
    const seen = this.eye.see(point);
    if (!seen) return;
    this.context.fillStyle = color;
    this.context.beginPath();
    this.context.arc(seen[0], seen[1], radius, 0, 7);
    this.context.fill();
  }

  cross(point, color, opacity) {
    const seen = this.eye.see(point), { context } = this;
    if (!seen) return;
    context.globalAlpha = opacity;
    Object.assign(context, { strokeStyle: color, lineWidth: 2 });
    context.beginPath();
    for (const side of [-1, 1]) {
      context.moveTo(seen[0] - 5, seen[1] - 5 * side);
      context.lineTo(seen[0] + 5, seen[1] + 5 * side);
    }
    context.stroke();
    context.globalAlpha = 1;
  }

  // A grid around the point that the eye looks at.
  ground(target) {
    const [x, y] = target.slice(0, 2).map((value) => 2 * Math.round(value / 2));
    for (let i = -8; i <= 8; i += 2) {
      const steps = Array.from({ length: 17 }, (_, j) => j - 8);
      this.line(steps.map((j) => [x + i, y + j, 0]), this.colors.grid, 1);
      this.line(steps.map((j) => [x + j, y + i, 0]), this.colors.grid, 1);
    }
  }

  // Arms and rotors, with a mark ahead.
  vehicle(flights, r, R, color, filled) {
    const { context } = this, hubs = flights.params("model", "rotor_positions_B");
    const at = (v) => sum(r, turnedBack(R, v));
    for (let i = 0; i < 4; i++) {
      const hub = Array.from(hubs.subarray(3 * i, 3 * i + 3));
      this.line([r, at(hub)], color, filled ? 3 : 1.5);
      const around = Array.from({ length: 17 }, (_, j) => {
        const angle = (2 * Math.PI * j) / 16;
        return at(sum(hub, [0.13 * Math.cos(angle), 0.13 * Math.sin(angle), 0.02]));
      });
      this.path(around, true);
      context.fillStyle = color;
      context.globalAlpha = 0.35;
      if (filled) context.fill();
      context.globalAlpha = 1;
      this.line(around, color, 1.5);
    }
    this.line([r, at([0.35, 0, 0])], color, filled ? 4 : 2);
  }

  // The ellipsoid r + A u, |u| <= 1, as three great circles.
  ellipsoid(r, A) {
    const center = this.eye.see(r), { context } = this;
    if (!center) return;
    const circle = (p, q) => Array.from({ length: 33 }, (_, j) => {
      const c = Math.cos((2 * Math.PI * j) / 32), s = Math.sin((2 * Math.PI * j) / 32);
      return [0, 1, 2].map((i) => r[i] + c * A[i][p] + s * A[i][q]);
    });
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      this.path(circle(p, q), true);
      context.fillStyle = this.colors.estimate;
      context.globalAlpha = 0.12;
      context.fill();
      context.globalAlpha = 0.6;
      Object.assign(context, { strokeStyle: this.colors.estimate, lineWidth: 1 });
      context.stroke();
      context.globalAlpha = 1;
    }
  }

  // Markers, and the rays to those in the last image.
  markers(simulation, k, r, R) {
    const { image } = simulation.pilots[k], { flights } = simulation, { context } = this;
    const fresh = flights.time - image.time < SIGHT ? image.pixels.map(({ feature }) => feature) : [];
    const eye = sum(r, turnedBack(R, Array.from(flights.params("model", "camera"))));
    simulation.features().forEach((place, i) => {
      const seen = this.eye.see(place), half = 4;
      if (fresh.includes(i)) this.line([eye, place], this.colors.ray, 1);
      if (!seen) return;
      context.fillStyle = fresh.includes(i) ? this.colors.fix : this.colors.faint;
      context.fillRect(seen[0] - half, seen[1] - half, 2 * half, 2 * half);
    });
  }

  // The last image of the vehicle's camera, in a corner.
  image(simulation, k) {
    const { context, colors, width } = this, { flights } = simulation, { image } = simulation.pilots[k];
    const half = flights.params("model", "half_image"), w = Math.min(110, 0.3 * width), h = (w * half[1]) / half[0];
    const left = width - w - 6, top = 6, age = flights.time - image.time;
    context.fillStyle = colors.inset;
    context.fillRect(left, top, w, h);
    Object.assign(context, { strokeStyle: colors.faint, lineWidth: 1 });
    context.strokeRect(left, top, w, h);
    context.fillStyle = colors.fix;
    context.globalAlpha = age < SIGHT ? 1 : 0.25;
    for (const { x, y } of image.pixels) {
      context.fillRect(left + 0.5 * w * (1 + x / half[0]) - 2, top + 0.5 * h * (1 + y / half[1]) - 2, 4, 4);
    }
    context.globalAlpha = 1;
  }
}
