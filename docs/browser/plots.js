// Curves over the last seconds, one for each controller, on a logarithmic scale.

const SPAN = 30; // [s]

class Plot {
  // `band`: values between which a consistent filter is in 95 % of the instants.
  constructor(canvas, { title, quantity, low, high, unitOf, band }) {
    Object.assign(this, { picture: new Picture(canvas, null), title, quantity, low, high, unitOf, band });
  }

  draw(simulation, colors) {
    const { context } = this.picture, [width, height] = this.picture.fit();
    const left = 46, right = width - 8, top = 22, bottom = height - 18;
    const end = Math.max(simulation.flights.time, SPAN), [low, high] = [this.low, this.high].map(Math.log10);
    const x = (time) => left + ((time - end + SPAN) / SPAN) * (right - left);
    const y = (value) => bottom - clip((Math.log10(value) - low) / (high - low), 0, 1) * (bottom - top);
    context.font = "12px system-ui, sans-serif";
    context.fillStyle = colors.text;
    context.textAlign = "left";
    context.fillText(this.title, 6, 13);
    if (this.band) {
      context.fillStyle = colors.band;
      context.fillRect(left, y(this.band[1]), right - left, y(this.band[0]) - y(this.band[1]));
    }
    Object.assign(context, { lineWidth: 1, strokeStyle: colors.grid, fillStyle: colors.text });
    for (let decade = Math.ceil(low); decade <= high; decade++) {
      const level = y(10 ** decade);
      context.beginPath();
      context.moveTo(left, level);
      context.lineTo(right, level);
      context.stroke();
      context.textAlign = "right";
      context.fillText(this.unitOf(10 ** decade), left - 5, level + 4);
    }
    context.textAlign = "center";
    for (let time = Math.ceil((end - SPAN) / 10) * 10; time <= end; time += 10) {
      context.fillText(`${time} s`, clip(x(time), left + 10, right - 12), height - 5);
    }
    simulation.pilots.forEach((pilot, k) => {
      Object.assign(context, { strokeStyle: colors.pilots[k], lineWidth: 1.6 });
      context.setLineDash(k === 1 ? [6, 4] : []); // two lines that coincide are both visible
      context.beginPath();
      pilot.times.forEach((time, i) => {
        if (time >= end - SPAN) context.lineTo(x(time), y(pilot[this.quantity][i]));
      });
      context.stroke();
    });
    context.setLineDash([]);
  }
}
