// Lines over time. What does not move is drawn once and kept.

const MARGIN = { left: 48, right: 8, top: 6, bottom: 6 };

class Chart {
  constructor(section, unit) {
    this.section = section;
    this.unit = unit;
    this.canvas = section.querySelector("canvas");
    this.output = section.querySelector("output");
    this.kept = document.createElement("canvas");
    this.lines = [];
    const seek = e => {
      const box = this.canvas.getBoundingClientRect();
      const share = (e.clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right);
      setPlaying(false);
      show(Math.min(Math.max(Math.round(share * (frames - 1)), 0), frames - 1));
    };
    this.canvas.addEventListener("pointerdown", e => { this.canvas.setPointerCapture(e.pointerId); seek(e); });
    this.canvas.addEventListener("pointermove", e => { if (e.buttons) seek(e); });
  }

  // lines: [{ name, color, values }]; least: how much the axis shows at any rate.
  set(lines, { least, both }) {
    this.lines = lines;
    this.both = both;
    this.top = nice(Math.max(1.05 * quantile(lines.flatMap(l => Array.from(l.values, Math.abs)), 0.99), least));
    this.stale = true;
  }

  x(t, width) { return MARGIN.left + (width - MARGIN.left - MARGIN.right) * t / Math.max(frames - 1, 1); }
  y(value, height) {  // what is beyond the axis runs along its end
    const low = this.both ? -this.top : 0, share = (Math.min(Math.max(value, low), this.top) - low) / (this.top - low);
    return height - MARGIN.bottom - (height - MARGIN.top - MARGIN.bottom) * share;
  }

  keep(width, height) {
    const ratio = window.devicePixelRatio || 1, pen = this.kept.getContext("2d");
    this.kept.width = Math.round(width * ratio);
    this.kept.height = Math.round(height * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "right";
    const tight = height - MARGIN.top - MARGIN.bottom < 36;  // no room for three labels
    for (const value of this.both ? [-this.top, 0, this.top] : [0, this.top / 2, this.top]) {
      const y = this.y(value, height), silent = tight && value < this.top;
      stroke(pen, [MARGIN.left, y], [width - MARGIN.right, y], value ? "#ececec" : "#c9c9c9", 1);
      pen.fillStyle = "#666";
      pen.textBaseline = y < 12 ? "top" : y > height - 12 ? "bottom" : "middle";
      if (!silent) pen.fillText(`${this.both && value > 0 ? "+" : ""}${Number(value.toPrecision(3))}${this.unit === "%" ? " %" : ""}`, MARGIN.left - 5, y);
    }
    for (const line of this.lines) this.trace(pen, line, width, height, line.color + (this.lines.length > 12 ? "80" : "c0"), 1);
    this.stale = false;
  }

  trace(pen, { values }, width, height, color, thick) {
    const step = Math.max(1, Math.floor(values.length / (2 * width)));
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left, 0, width, height);
    pen.clip();
    pen.strokeStyle = color;
    pen.lineWidth = thick;
    pen.beginPath();
    let on = false;
    for (let t = 0; t < values.length; t += step) {
      if (Number.isNaN(values[t])) { on = false; continue; }
      const [x, y] = [this.x(t, width), this.y(values[t], height)];
      if (on) pen.lineTo(x, y); else pen.moveTo(x, y);
      on = true;
    }
    pen.stroke();
    pen.restore();
  }

  draw(chosen) {
    const { pen, width, height } = open(this.canvas);
    if (!width || !height) return;
    if (this.stale || Math.round(width * (window.devicePixelRatio || 1)) !== this.kept.width) this.keep(width, height);
    pen.drawImage(this.kept, 0, 0, width, height);
    const marked = this.lines.filter(chosen);
    for (const line of marked) this.trace(pen, line, width, height, line.color, 2.2);
    const x = this.x(state.frame, width);
    stroke(pen, [x, 0], [x, height], "#222222", 1);
    let most = null;
    for (const line of marked.length ? marked : this.lines) {
      const value = line.values[state.frame];
      if (Number.isFinite(value) && (!most || Math.abs(value) > Math.abs(most.value))) most = { value, name: line.name };
    }
    const shown = most && `${this.both && most.value > 0 ? "+" : ""}${Number(most.value.toPrecision(2))} ${this.unit}`;
    this.output.textContent = most ? `${marked.length ? "" : "most: "}${shown} · ${most.name}` : "";
  }
}
