// The motion: what the page's data hold, and where everybody's joints are in a frame.

const data = JSON.parse(document.getElementById("data").textContent);
const byId = id => document.getElementById(id);
const people = data.people;
const frames = Math.max(...people.map(p => p.frames));
const state = {
  frame: 0, playing: false, mirror: false, walk: false, follow: false, bars: true, names: false,
  person: 0, hover: null, yaw: 0, pitch: 0, zoom: 1, pan: [0, 0],
};

// Floats and bytes as they are; 16-bit integers times a step, the lowest of them for NaN.
const unpack = part => {
  const buffer = Uint8Array.from(atob(part.data), c => c.charCodeAt(0)).buffer;
  if (part.kind === "f4") return new Float32Array(buffer);
  if (part.kind === "u1") return new Uint8Array(buffer);
  return Float32Array.from(new Int16Array(buffer), v => v === -32768 ? NaN : v * part.step);
};

const TRUNKS = [data.colours.centre, "#009e73", "#b5548f", "#b98300", "#56b4e9"];  // tell people apart
people.forEach((person, k) => {
  person.number = k;
  person.chosen = 0;
  person.middle = data.middle.map((m, a) => m - person.shift[a]);  // where its own origin is
  person.count = person.joints.length;
  person.colours = { ...data.colours, centre: TRUNKS[k % TRUNKS.length] };
  for (const key of ["tracks", "weights"]) person[key] = unpack(person[key]);
  for (const s of person.solutions) {
    for (const key of ["points", "centres", "path", "fit", "spread"]) if (s[key]) s[key] = unpack(s[key]);
    s.home = s.path ? s.path.reduce((a, b) => a + b, 0) / s.path.length : 0;
  }
  for (const key of ["path", "lens", "fit", "spread", "home"])  // those of the solution that is shown
    Object.defineProperty(person, key, { get: () => person.solutions[person.chosen][key] });
  person.blank = Array.from({ length: person.frames }, (_, t) =>
    !person.weights.subarray(t * person.count, (t + 1) * person.count).some(w => w > 0));
});

// Joints of a person in a frame as x right, y down, z away, one after another.
const place = (person, t) => {
  const { points, centres } = person.solutions[person.chosen], n = person.count, out = new Float64Array(3 * n);
  for (let i = 0; i < 3 * n; i++) out[i] = points[3 * n * t + i] + centres[3 * t + i % 3];
  const [mx, my, mz] = person.middle, far = person.lens ? person.path[t] : 0;
  for (let i = 0; i < 3 * n; i += 3) {
    if (state.mirror && person.lens) {  // each joint moves along its ray
      const depth = out[i + 2] + mz, near = Math.max(far - depth, 0.01 * far), ratio = near / (far + depth);
      out[i] = (out[i] + mx) * ratio - mx;
      out[i + 1] = (out[i + 1] + my) * ratio - my;
      out[i + 2] = near - far - mz;
    } else if (state.mirror) out[i + 2] = -out[i + 2];
  }
  const turn = state.mirror && !person.lens ? -1 : 1;
  const shift = state.walk && person.path ? turn * (person.path[t] - person.home) : 0;
  if (shift) for (let i = 2; i < 3 * n; i += 3) out[i] += shift;
  return out;
};

// Where the camera sees those joints in the image: [x, y] one after another.
const project = (person, t, joints) => {
  const out = new Float64Array(2 * person.count), [mx, my, mz] = person.middle;
  const shift = person.lens ? person.path[t] - (state.walk ? person.path[t] - person.home : 0) : 0;
  for (let j = 0; j < person.count; j++) {
    const x = joints[3 * j], y = joints[3 * j + 1];
    if (person.lens) {
      const [fx, fy, cx, cy] = person.lens, z = joints[3 * j + 2] + mz + shift;
      out[2 * j] = fx * (x + mx) / z + cx;
      out[2 * j + 1] = fy * (y + my) / z + cy;
    } else {
      out[2 * j] = person.fit[3 * t] * x + person.fit[3 * t + 1];
      out[2 * j + 1] = person.fit[3 * t] * y + person.fit[3 * t + 2];
    }
  }
  return out;
};

// The mean of everybody's joints in a frame, for the view that follows.
const centre = bodies => {
  const sum = [0, 0, 0];
  let number = 0;
  for (const { joints } of bodies) for (let i = 0; i < joints.length; i += 3) {
    if (Number.isNaN(joints[i])) continue;
    for (let a = 0; a < 3; a++) sum[a] += joints[i + a];
    number++;
  }
  return sum.map(s => s / Math.max(number, 1));
};

// Among several people one is there from the first frame in which anything is seen of them to the last.
const present = (p, t) => t < p.frames && (people.length === 1 || (t >= p.blank.indexOf(false) && t <= p.blank.lastIndexOf(false)));
const bodiesAt = t => {
  const bodies = people.filter(p => present(p, t)).map(person => ({ person, joints: place(person, t) }));
  if (state.follow) {
    const middle = centre(bodies);
    for (const { joints } of bodies) for (let i = 0; i < joints.length; i++) joints[i] -= middle[i % 3];
    for (const body of bodies) body.middle = middle;
  }
  return bodies;
};

// Length of each rigid bone over time, as deviation from its mean in per cent.
const deviations = person => {
  const all = Array.from({ length: person.frames }, (_, t) => place(person, t));
  return person.rigid.map(b => {
    const [p, c] = person.bones[b];
    const lengths = all.map(q => Math.hypot(q[3 * p] - q[3 * c], q[3 * p + 1] - q[3 * c + 1], q[3 * p + 2] - q[3 * c + 2]));
    const known = lengths.filter(Number.isFinite), mean = known.reduce((a, l) => a + l, 0) / Math.max(known.length, 1);
    return Float32Array.from(lengths, l => mean > 0 ? 100 * (l / mean - 1) : NaN);
  });
};

const quantile = (values, q) => {
  const sorted = Float64Array.from(values).filter(Number.isFinite).sort();
  return sorted.length ? sorted[Math.round(q * (sorted.length - 1))] : 0;
};
const nice = step => {
  const power = 10 ** Math.floor(Math.log10(step));
  return [1, 2, 5, 10].map(m => m * power).find(v => v >= step * (1 - 1e-9));
};
const alike = (a, b, share) => `rgb(${[1, 3, 5].map(i => {
  const from = parseInt(a.slice(i, i + 2), 16), to = parseInt(b.slice(i, i + 2), 16);
  return Math.round(from + share * (to - from));
}).join(",")})`;

// A canvas as sharp as the screen: its context, in CSS pixels, and its size.
const open = canvas => {
  const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.lineCap = pen.lineJoin = "round";
  return { pen, width, height };
};
