// The 3D view: an orbiting camera, the floor, and bodies drawn from far to near.

const VIEWS = { three: [-0.6, 0.22], camera: [0, 0], side: [Math.PI / 2, 0.08], top: [0, Math.PI / 2] };
const FOCAL = 2.2;  // in shorter sides of the canvas: a long lens, so that bodies keep their shape
const SAMPLES = 600;
const FONT = "12px system-ui, sans-serif";
let room = null;  // how far the motion reaches, and how far away the eye stands
let spots = [];   // joints on the screen, for pointing at them

const basis = () => {
  const [sy, cy, sp, cp] = [Math.sin(state.yaw), Math.cos(state.yaw), Math.sin(state.pitch), Math.cos(state.pitch)];
  // y is down in the data and up in the picture
  return { right: [cy, 0, sy], up: [-sy * sp, -cp, cy * sp], eye: [sy * cp, -sp, -cy * cp] };
};
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// Look over the whole clip once; lost points do not count. Depth reaches as far in both mirror images.
const measure = () => {
  const step = Math.max(1, Math.floor(frames / SAMPLES)), reach = [[], [], []], bodySizes = people.map(() => []);
  for (let t = 0; t < frames; t += step) for (const { person, joints } of bodiesAt(t)) {
    const own = [[], []];
    for (let i = 0; i < joints.length; i += 3) {
      if (Number.isNaN(joints[i])) continue;
      for (let a = 0; a < 3; a++) reach[a].push(joints[i + a]);
      own[0].push(joints[i]); own[1].push(joints[i + 1]);
    }
    if (own[0].length) bodySizes[person.number].push(Math.max(...own.map(v => Math.max(...v) - Math.min(...v))));
  }
  const low = reach.map(v => quantile(v, 0.002)), high = reach.map(v => quantile(v, 0.998));
  const depth = Math.max(-low[2], high[2]);
  low[2] = -depth; high[2] = depth;
  const size = Math.max(...low.map((l, a) => high[a] - l), 1e-9);
  for (const a of [0, 2]) {
    const lack = Math.max(0.4 * size - (high[a] - low[a]), 0) / 2 + 0.06 * size;
    low[a] -= lack; high[a] += lack;
  }
  people.forEach((p, k) => { p.size = quantile(bodySizes[k], 0.5) || size; });
  room = { low, high, size, target: low.map((l, a) => (l + high[a]) / 2), reach };
  fit();
};

// Stand so far away, and shift the picture so, that motion and floor fill the canvas from where one looks.
const fit = () => {
  const canvas = byId("space"), width = canvas.clientWidth, height = canvas.clientHeight;
  const { low, high, reach: [xs, ys, zs] } = room, stride = Math.max(1, Math.floor(xs.length / 10000)), shown = [];
  for (let i = 0; i < xs.length; i += stride) for (const sign of [1, -1]) shown.push([xs[i], ys[i], sign * zs[i]]);
  const floor = [low[0], high[0]].flatMap(x => [low[2] - 0.05 * room.size, high[2]].map(z => [x, high[1], z]));
  state.zoom = 1;
  state.pan = [0, 0];
  room.distance = 4 * room.size;
  for (let round = 0; round < 8; round++) {
    const see = lens(width, height);
    const ends = [0, 1].map(a => {
      const places = shown.map(p => see(...p)[a]), corners = floor.map(p => see(...p)[a]);
      return [Math.min(quantile(places, 0.001), ...corners), Math.max(quantile(places, 0.999), ...corners)];
    });
    const [[left, right], [top, bottom]] = ends;
    room.distance *= Math.max((right - left) / (0.94 * width), (bottom - top) / (0.87 * height), 0.2);
    state.pan = [state.pan[0] + width / 2 - (left + right) / 2, state.pan[1] + 0.515 * height - (top + bottom) / 2];
  }
};

const lens = (width, height) => {
  const { right, up, eye } = basis(), focal = FOCAL * Math.min(width, height), away = room.distance / state.zoom;
  return (x, y, z) => {
    const p = [x - room.target[0], y - room.target[1], z - room.target[2]];
    const depth = Math.max(away - dot(p, eye), 1e-3 * away), scale = focal / depth;
    return [width / 2 + state.pan[0] + scale * dot(p, right), height / 2 + state.pan[1] - scale * dot(p, up), depth, scale];
  };
};

const stroke = (pen, a, b, color, width) => {
  pen.strokeStyle = color;
  pen.lineWidth = width;
  pen.beginPath();
  pen.moveTo(a[0], a[1]);
  pen.lineTo(b[0], b[1]);
  pen.stroke();
};
const disc = (pen, x, y, radius, fill, edge) => {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
  if (fill) { pen.fillStyle = fill; pen.fill(); }
  if (edge) { pen.strokeStyle = edge; pen.lineWidth = 1.4; pen.stroke(); }
};

const drawFloor = (pen, see) => {
  const { low, high, size } = room, ground = high[1], step = nice(size / 12);
  const edge = [[low[0], low[2]], [high[0], low[2]], [high[0], high[2]], [low[0], high[2]]].map(([x, z]) => see(x, ground, z));
  pen.fillStyle = "#f7f7f5";
  pen.beginPath();
  edge.forEach(([x, y], i) => i ? pen.lineTo(x, y) : pen.moveTo(x, y));
  pen.fill();
  for (let x = Math.ceil(low[0] / step) * step; x <= high[0]; x += step) stroke(pen, see(x, ground, low[2]), see(x, ground, high[2]), "#e4e4e0", 1);
  for (let z = Math.ceil(low[2] / step) * step; z <= high[2]; z += step) stroke(pen, see(low[0], ground, z), see(high[0], ground, z), "#e4e4e0", 1);
  // The side of the floor that is towards the camera, with an arrow along its rays.
  stroke(pen, edge[0], edge[1], "#9a9a96", 1.5);
  const x = (low[0] + high[0]) / 2, tip = see(x, ground, low[2] + 0.07 * size), tail = see(x, ground, low[2]);
  const wings = [-1, 1].map(s => see(x + 0.018 * s * size, ground, low[2] + 0.04 * size));
  stroke(pen, tail, tip, "#9a9a96", 1.5);
  for (const wing of wings) stroke(pen, tip, wing, "#9a9a96", 1.5);
  const label = see(x, ground, low[2] - 0.02 * size);
  text(pen, "camera's side", label[0] + 6, label[1] + 12, { color: "#80807c", align: "center", halo: false });
};

const text = (pen, words, x, y, { color = "#222", align = "left", halo = true, weight = "" } = {}) => {
  pen.font = `${weight} ${FONT}`;
  pen.textAlign = align;
  pen.textBaseline = "middle";
  if (halo) { pen.strokeStyle = "#ffffffdd"; pen.lineWidth = 3; pen.strokeText(words, x, y); }
  pen.fillStyle = color;
  pen.fillText(words, x, y);
};

// Names of the joints, nearest first; one that would cover another is left out.
const writeNames = pen => {
  pen.font = FONT;
  const taken = [];
  for (const { x, y, person, joint } of [...spots].sort((a, b) => a.depth - b.depth)) {
    const wide = pen.measureText(person.joints[joint]).width;
    if (taken.some(t => Math.abs(t.y - y) < 12 && x < t.x + t.wide && t.x < x + wide)) continue;
    taken.push({ x, y, wide });
    text(pen, person.joints[joint], x + 7, y, { color: "#333" });
  }
};

const drawSpace = bodies => {
  const { pen, width, height } = open(byId("space"));
  const see = lens(width, height), ground = room.high[1], items = [];
  drawFloor(pen, see);
  spots = [];
  pen.lineCap = "round";
  for (const { person, joints } of bodies) {
    const at = j => see(joints[3 * j], joints[3 * j + 1], joints[3 * j + 2]);
    const known = j => !Number.isNaN(joints[3 * j]);
    const thick = 0.021 * person.size, loose = person.bones.length ? 0.011 : 0.025;
    const radius = new Float64Array(person.count).fill(loose * person.size);
    const faint = person.blank[state.frame] ? 0.65 : 0, shadow = [];
    for (const [a, b, side] of person.bones) {
      if (!known(a) || !known(b)) continue;
      const p = at(a), q = at(b);
      const length = Math.hypot(joints[3 * a] - joints[3 * b], joints[3 * a + 1] - joints[3 * b + 1], joints[3 * a + 2] - joints[3 * b + 2]);
      const broad = Math.min(thick, 0.25 * length);
      radius[a] = Math.min(radius[a], Math.max(0.8 * broad, 0.004 * person.size));
      radius[b] = Math.min(radius[b], Math.max(0.8 * broad, 0.004 * person.size));
      shadow.push(see(joints[3 * a], ground, joints[3 * a + 2]), see(joints[3 * b], ground, joints[3 * b + 2]));
      items.push({ depth: (p[2] + q[2]) / 2, p, q, width: Math.max(broad * (p[3] + q[3]) / 2, 1.5), color: person.colours[side], faint });
    }
    pen.strokeStyle = faint ? "#ededeb" : "#d9d9d6";
    pen.lineWidth = shadow.length ? Math.max(0.7 * thick * shadow[0][3], 1.5) : 1;
    pen.beginPath();
    shadow.forEach(([x, y], i) => i % 2 ? pen.lineTo(x, y) : pen.moveTo(x, y));
    pen.stroke();
    for (let j = 0; j < person.count; j++) if (known(j)) {
      const p = at(j), seen = person.weights[state.frame * person.count + j] > 0;
      items.push({ depth: p[2] - 0.02 * person.size, p, width: Math.max(radius[j] * p[3], 1.6), color: person.colours[person.sides[j]], faint, joint: true, seen });
      spots.push({ x: p[0], y: p[1], depth: p[2], person, joint: j });
      const deviation = person.spread && state.bars ? person.spread[state.frame * person.count + j] : 0;
      if (deviation > 0) {
        const [x, y, z] = joints.subarray(3 * j, 3 * j + 3);
        const pointed = state.hover && state.hover.person === person && state.hover.joint === j;
        const color = person.colours[person.sides[j]];
        stroke(pen, see(x, y, z - deviation), see(x, y, z + deviation), pointed ? color : color + "38", pointed ? 2.5 : 2);
      }
    }
  }
  items.sort((a, b) => b.depth - a.depth);
  const near = Math.min(...items.map(i => i.depth)), far = Math.max(...items.map(i => i.depth));
  const depths = Math.max(far - near, 0.3 * room.size);
  for (const { depth, p, q, width, color, faint, joint, seen } of items) {
    const shade = alike(color, "#ffffff", Math.max(faint, 0.4 * (depth - near) / depths));
    if (joint) disc(pen, p[0], p[1], width, seen ? shade : "#ffffff", seen ? null : shade);
    else {
      stroke(pen, p, q, "#ffffff", width + 2);
      stroke(pen, p, q, shade, width);
    }
  }
  if (state.hover) {
    const spot = spots.find(s => s.person === state.hover.person && s.joint === state.hover.joint);
    if (spot) disc(pen, spot.x, spot.y, 8, null, "#222");
  }
  if (state.names) writeNames(pen);
  if (people.length > 1) for (const { person } of bodies) {
    const own = spots.filter(s => s.person === person);
    if (!own.length) continue;
    const top = own.reduce((a, b) => b.y < a.y ? b : a);
    text(pen, person.name, top.x, top.y - 16, { color: person.colours.centre, align: "center", weight: "600" });
  }
};

// One finger or the mouse turns, two fingers or the wheel zoom, the right button or shift moves.
const listenSpace = (canvas, redraw) => {
  const fingers = new Map();
  const span = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  canvas.addEventListener("pointerdown", e => {
    canvas.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
  });
  canvas.addEventListener("pointermove", e => {
    const last = fingers.get(e.pointerId);
    if (!last) return;
    const dx = e.clientX - last.x, dy = e.clientY - last.y, before = fingers.size === 2 ? span() : 0;
    last.x = e.clientX; last.y = e.clientY;
    if (fingers.size === 2) zoom(span() / Math.max(before, 1));
    else if (e.shiftKey || e.buttons === 2) state.pan = [state.pan[0] + dx, state.pan[1] + dy];
    else {
      state.yaw -= 0.008 * dx;
      state.pitch = Math.min(Math.max(state.pitch + 0.008 * dy, -0.1), Math.PI / 2);
    }
    redraw();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, e => fingers.delete(e.pointerId));
  const zoom = by => { state.zoom = Math.min(Math.max(state.zoom * by, 0.2), 20); };
  canvas.addEventListener("wheel", e => { e.preventDefault(); zoom(Math.exp(-0.0012 * e.deltaY)); redraw(); }, { passive: false });
  canvas.addEventListener("contextmenu", e => e.preventDefault());
  canvas.addEventListener("dblclick", () => { fit(); redraw(); });
};
